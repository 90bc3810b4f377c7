"""Diagnosis: facts in, one sentence per fault out, each with its remedy."""
