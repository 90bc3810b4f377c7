"""Every timeout, noise, rate and cap of camera sources, one section per kind of source."""

# Opening (`newest_slot`): between two attempts to open a camera that is away.
CAMERA_FIRST_BACKOFF_S, CAMERA_LONGEST_BACKOFF_S = 0.5, 5.0
# A read in progress ends by its own timeout, which may be longer than anybody waits.
CAMERA_CLOSE_TIMEOUT_S = 0.8
# Over which rates are counted (`source_status`).
CAMERA_RATE_WINDOW_S = 2.0

# Decoding (`decode`), 33 megapixels: beyond any drone's camera; a JPEG of 2 kB may claim 65535 x 65535 and ask for
# 12 GB.
MAX_DECODED_PIXELS = 1 << 25

# Streams over HTTP and RTSP (`http_stream`, `multipart`, `rtsp`): a stamp further from a clock is not of that clock,
# and no tracker reaches back so far.
HTTP_STAMP_WINDOW_S = 2.0
# Least age of a frame at its arrival, over the last STAMPS_COMPARED: a smaller one shows that the two clocks disagree,
# and with a larger one no frame would be used (camera.max_age_s), whether by latency or by the clocks.
HTTP_LEAST_AGE_S = (-0.005, 0.5)
STAMPS_COMPARED = 20
# A larger least age is that of a slow stream or of a clock that is behind; what is estimated in flight covers so much.
STAMP_LATE_S = 0.15
HTTP_MONOTONIC_SIGMA_S = 1e-3
# Two machines synchronised over a radio link.
HTTP_UTC_SIGMA_S = 5e-3
MAX_PART_BYTES, MAX_PART_HEADER_BYTES = 16 << 20, 16 << 10
# Dashes around a boundary: as many as the longest boundary has signs (RFC 2046).
MOST_BOUNDARY_DASHES = 70
# A shorter boundary occurs in images by chance, and is looked for with its dashes only.
SHORT_BOUNDARY = 6
# In front of a JPEG's scan; a camera writes ten.
MOST_JPEG_SEGMENTS = 200
RTSP_PORT = 554

# Cameras that detect by themselves (`detection_stream`); of one frame, the best are kept, as many as our own detector
# gives.
MAX_DETECTION_LINE_BYTES = 64 << 10
MAX_STREAMED_DETECTIONS = 64

# V4L2 (`v4l2`): the kernel stamps when it handles the first packet or interrupt of a frame.
KERNEL_STAMP_SIGMA_S = 1e-3
# Least age of a frame when the kernel gives it, as of HTTP: with another, the stamps are of another clock, whatever
# their flags say. Where the exposure's start is stamped, a period at most is to be added.
V4L2_LEAST_AGE_S = (-0.005, 0.5)
# Frames that waited while the event loop stood still are that old at most.
V4L2_STAMP_WINDOW_S = 60.0
# Without a frame until it is reported: periods, and at least so long.
CAMERA_SILENT_PERIODS, CAMERA_SILENT_AT_LEAST_S = 10, 0.5
# Of silence: many USB cameras recover only so; the first frame may take them two.
CAMERA_REOPEN_AFTER_S = 3.0
# Where the driver does not tell.
DEFAULT_FRAME_PERIOD_S = 1 / 30

# Files (`video`): where a file does not tell its rate.
DEFAULT_VIDEO_HZ = 30.0
# Between two frames; more is a damaged time, for which nobody wants to wait.
LONGEST_VIDEO_PAUSE_S = 10.0
# More are nonsense of a header.
MOST_VIDEO_FRAMES = 1e8
# In a row until the end is believed: behind a damaged part there may be more.
MOST_FAILED_READS = 16
# Between the last frame and the end that the header announces.
END_SLACK_PERIODS = 1.5
# From this many bits per pixel on, 8 are not enough to show what a scene holds.
DEEP_BITS = 12
