"""Flags of the scripts: files that they write at their end are checked at their start."""

import argparse

import pytest

from scripts.running.flags import output_file


def test_a_file_that_cannot_be_written_is_refused(tmp_path):
    assert output_file(str(tmp_path / "new.json")) == tmp_path / "new.json"
    for path in (tmp_path, tmp_path / "missing" / "new.json"):
        with pytest.raises(argparse.ArgumentTypeError):
            output_file(str(path))
    assert not list(tmp_path.iterdir())
