"""Errors of the case studies, each with one sentence for the user."""

from typing import ClassVar


class CaseStudyError(Exception):
    """Base class of the case studies' errors; `str()` is one sentence that says what to do."""

    exit_code: ClassVar[int] = 2


class DataFileError(CaseStudyError):
    """A file of recorded data is missing or is not valid."""
