"""Texts from outside: a server's reason, a device's or a file's name, a model's metadata, a peer's words.

Whatever we did not write ourselves may hold anything: escape sequences that a terminal obeys, newlines that forge a
line of the log, halves of characters that no encoder takes, a hundred kilobytes. Each such text goes through `plain`
before it is shown, logged or sent.
"""

from __future__ import annotations

import re

LONGEST_PLAIN_TEXT = 500
"""Characters of one line."""
LONGEST_OF_SEVERAL = 2000
MOST_LINES = 200
UNPRINTABLE = "\N{REPLACEMENT CHARACTER}"


def plain(text: str, longest: int = LONGEST_PLAIN_TEXT) -> str:
    """One line of at most `longest` characters, all of which can be printed and encoded.

    Newlines and other white space become spaces, and what is cut ends in "…".
    """
    if len(text) > longest:
        text = f"{text[: longest - 1]}…"
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else " " if sign.isspace() else UNPRINTABLE for sign in text)


# Of addresses that name no file, whose name may hold any sign.
_SCHEME = r"\b(?!(?:file|images|v4l2|sim|tlog|ulog):)[a-z][a-z0-9+.-]{0,20}:"
_LOGIN = re.compile(
    rf"({_SCHEME}(?://)?+)(?!\[?(?:USER:)?PASSWORD@)(?:[^\s\"@]{{1,300}}+@)+",
    re.IGNORECASE,
)
# Whole, or the path and query alone, which a server may repeat. No sign of a path stands in front of it, so no text is
# tried twice.
_PATH = r"[\w/:.%~+@-]"
_URL = re.compile(
    rf"(?:{_SCHEME}//|(?<!{_PATH})/(?!dev/){_PATH}*\?)[^\s\"]*[^\s\"'),;:]",
    re.IGNORECASE,
)
_SECRET = re.compile(r"\b(\w{0,60}(?:pass|pwd|psw|loginpas|secret|token)\w{0,20}=)[^\s\"&;]+", re.IGNORECASE)
# Options of our own, and numbers too short for a secret: the channel of a recorder.
_HARMLESS = re.compile(r"(?:(?:latency_ms|sigma_ms|timeout_s|resize)=.*|\w+=\d{1,2})?")


def hide_logins(text: str) -> str:
    """The text with "…" in place of users and passwords in addresses, also in their paths and queries.

    Cameras name the parameter of a password as they like (`pwd`, `p`, `auth`), so no value of a URL's is shown.
    """
    if "@" in text:
        text = _LOGIN.sub(r"\1…@", text)
    if "?" in text or "=" in text:
        text = _URL.sub(_hide_values, text)
    return _SECRET.sub(r"\1…", text) if "=" in text else text


def _hide_values(url: re.Match[str]) -> str:
    path, mark, query = url[0].partition("?")
    name, equals, _ = path.partition("=")
    shown = (
        item if _HARMLESS.fullmatch(item) else re.sub("^([^=]+=).+|.+", r"\1…", item)
        for item in query.split("&")
    )
    return f"{name}{equals and '=…'}{mark}{'&'.join(shown)}"


def plain_lines(text: str) -> str:
    """The same for a text of several lines, each of which stays one: MOST_LINES at most, each LONGEST_OF_SEVERAL."""
    lines = text[: MOST_LINES * LONGEST_OF_SEVERAL].split("\n", MOST_LINES)
    if len(lines) > MOST_LINES:
        lines[MOST_LINES:] = ["…"]
    return "\n".join(plain(line, LONGEST_OF_SEVERAL) for line in lines)
