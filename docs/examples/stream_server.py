"""Serves the parts or lines that a camera's program yields over HTTP: each client gets the newest, at its own pace.

For picamera2_mjpeg.py, imx500_detections.py and oak_detections.py, which stand beside it. Standard library only. There
is no password: at any other `--host` than the loopback address, anyone in the network sees the stream.
"""

import argparse
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

MOST_CLIENTS = 8


def arguments(about, port):
    """A parser with what all servers take."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=port, help="default: %(default)s")
    parser.add_argument("--utc", action="store_true", help="stamp in UTC, for an agent on another machine")
    return parser


def agent_time(t, utc):
    """t: s on CLOCK_MONOTONIC, which an agent on this machine uses; UTC for others, whose clocks are synchronised."""
    return t + time.time() - time.monotonic() if utc else t


def serve(items, content_type, host, port):
    """Send `items`, an iterator of bytes, to all clients until it ends; its errors end the program."""
    newest, number, came = b"", 0, threading.Condition()
    seats = threading.Semaphore(MOST_CLIENTS)

    class Stream(BaseHTTPRequestHandler):
        timeout = 5.0  # s: a client that reads nothing for so long is gone

        def do_GET(self):
            if not seats.acquire(blocking=False):
                self.send_error(503, f"expected at most {MOST_CLIENTS} clients")
                return
            try:
                self.send_response(200)
                self.send_header("Content-Type", content_type)
                self.end_headers()
                sent = number
                while True:
                    with came:
                        while number == sent:
                            came.wait()
                        item, sent = newest, number
                    self.wfile.write(item)
            except OSError:
                self.close_connection = True
            finally:
                seats.release()

        def log_message(self, *args):
            pass

    server = ThreadingHTTPServer((host, port), Stream)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for item in items:
        with came:
            newest, number = item, number + 1
            came.notify_all()
