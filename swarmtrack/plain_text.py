"""Texts from outside: a server's reason, a device's or a file's name, a model's metadata, a peer's words.

Whatever we did not write ourselves may hold anything: escape sequences that a terminal obeys, newlines that forge a
line of the log, halves of characters that no encoder takes, a hundred kilobytes. Each such text goes through `plain`
before it is shown, logged or sent.
"""

from __future__ import annotations

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


def plain_lines(text: str) -> str:
    """The same for a text of several lines, each of which stays one: MOST_LINES at most, each LONGEST_OF_SEVERAL."""
    lines = text[: MOST_LINES * LONGEST_OF_SEVERAL].split("\n", MOST_LINES)
    if len(lines) > MOST_LINES:
        lines[MOST_LINES:] = ["…"]
    return "\n".join(plain(line, LONGEST_OF_SEVERAL) for line in lines)
