"""Docstrings of public names begin with a noun or a verb, without the turns that make a reader go back."""

import ast

import pytest

from project.test_prose import REFUSED as REFUSED_IN_PROSE
from support.places import ROOT
