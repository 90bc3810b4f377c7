"""The top of the repository holds what a newcomer should see there, and no accident."""

import subprocess

import pytest

from support.places import ROOT

TOP = {
    ".ci", ".dockerignore", ".gitignore", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "README.md", "agents",
    "benchmarks", "configs", "docker", "docs", "mkdocs.yml", "pyproject.toml", "requirements-dev.lock",
    "requirements.lock", "swarmtrack", "tests",
}  # fmt: skip


def test_the_top_of_the_repository_holds_nothing_else():
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert {path.split("/")[0] for path in listed.split("\0") if path} == TOP
