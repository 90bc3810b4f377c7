"""Where things are: the checkout, and the data that lies beside it on some machines."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
DOCS = ROOT / "docs"
SHARED = ROOT.parent / "shared" / "data"
V4L2_STAND_IN = Path(__file__).parent / "v4l2_stand_in"
PYTHONPATH = os.pathsep.join([str(ROOT), str(ROOT / "tests")])  # of a test that starts itself as a process


def writer(folder, usual):
    """A function that writes a text into a file of the folder, and says where that is."""

    def write(text, name=usual):
        path = folder / name
        path.write_text(text)
        return path

    return write
