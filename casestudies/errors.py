"""What the case studies' processes refuse, each as one sentence for the user."""

from typing import ClassVar


class CaseStudyError(Exception):
    """Root of the case studies' errors; `str()` is one sentence that says what to do."""

    exit_code: ClassVar[int] = 2


class DataFileError(CaseStudyError):
    """A file of recorded data that is not there, or is another kind of file."""
