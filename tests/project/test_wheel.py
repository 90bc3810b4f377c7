"""The wheel: the same bytes whoever builds it, whenever and wherever (docs/release.md), and what stands in it."""

import os
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from support.patience import PATIENCE
from support.places import ROOT

pytest.importorskip("hatchling", reason="hatchling builds the wheel")


def built(folder: Path, umask: int) -> Path:
    """The wheel of a copy of what git tracks and would track, made in a folder under a umask."""
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    before = os.umask(umask)
    try:
        for name in filter(None, files.split("\0")):
            if not name.startswith(("tests/", "docs/")) and (ROOT / name).exists():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, folder / name, follow_symlinks=False)
                if os.access(ROOT / name, os.X_OK) and not (ROOT / name).is_symlink():
                    (folder / name).chmod(0o777 & ~umask)
        command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder / "dist")]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=PATIENCE)
    finally:
        os.umask(before)
    (wheel,) = (folder / "dist").glob("*.whl")
    return wheel


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout")
def test_a_wheel_is_the_same_wherever_it_is_built_and_says_whose_it_is(tmp_path):
    first = built(tmp_path / "a", 0o022)
    second = built(tmp_path / "elsewhere" / "b", 0o077)
    with zipfile.ZipFile(first) as here, zipfile.ZipFile(second) as there:
        assert [vars_of(entry) for entry in here.infolist()] == [vars_of(entry) for entry in there.infolist()]
        names = here.namelist()
        (about,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        metadata = Parser().parsestr(here.read(about).decode())
    assert first.read_bytes() == second.read_bytes()
    assert not [name for name in names if "__pycache__" in name or name.startswith(("tests", "docs"))]
    assert metadata["Author"] == "The swarmtrack maintainers"
    assert "Programming Language :: Python :: 3.11" in metadata.get_all("Classifier")
    assert set(metadata.get_all("Provides-Extra")) >= {"train", "bench", "docs", "release", "dev"}


def vars_of(entry: zipfile.ZipInfo) -> tuple[object, ...]:
    return entry.filename, entry.date_time, entry.external_attr, entry.CRC
