"""Loader of a case study's `model.py`. It calls the file's function `model` with the values of `--set`."""

import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pydantic import PydanticUserError, TypeAdapter, ValidationError

from toolchain.bounded_files import nearest_name
from toolchain.errors import ModelError, ToolchainError
from toolchain.models.joint import Question
from toolchain.models.model import Model

FILE_NAME = "model.py"
_TOOLCHAIN = Path(__file__).parent.parent

_Result = TypeVar("_Result")


def load_model(case: Path, settings: Mapping[str, str]) -> Model:
    """Return the model of a case study for a BM1. `load_question` describes the arguments and errors."""
    found = load_question(case, settings)
    return found.model() if isinstance(found, Question) else found


def load_question(case: Path, settings: Mapping[str, str]) -> Model | Question:
    """Return the model or the question of a case study, or raise a ModelError.

    `case` is a folder with a `model.py`, a path of a `model.py`, or the name of an installed model. The file can import
    modules in its folder. The file defines a function `model`. This function returns a `toolchain.models.Question` or a
    `toolchain.models.Model`. `settings` are the arguments of `model`, as text by name. Each argument is converted to
    the annotated type of its parameter: int, float, bool, str, Path, an Enum or a Literal.
    """
    path = existing_model_path(case)
    folder = str(path.parent.resolve())
    sys.path.append(folder)  # last, so that modules of the folder do not hide others
    try:
        with redirect_stdout(sys.stderr):  # standard output belongs to the command, which may print JSON
            function = _model_function(path)
            arguments = _arguments(path, function, settings)
            model = _guarded(path, "model()", lambda: function(**arguments))
    finally:
        sys.path.remove(folder)
    if not isinstance(model, Model | Question):
        raise ModelError(
            f"{path}: model() returned {type(model).__name__}, expected a toolchain.models.Question or a "
            "toolchain.models.Model"
        )
    return model


def installed_models() -> dict[str, Path]:
    """Return the files of the models that are installed with rosbayes, by name, such as `boat`.

    The function finds the files without importing a case study.
    """
    package = importlib.util.find_spec("casestudies")
    folders = (package and package.submodule_search_locations) or ()
    return {path.parent.name: path for each in folders for path in sorted(Path(each).glob(f"*/{FILE_NAME}"))}


def model_path(case: Path) -> Path:
    """Return the path of a `model.py`: the given file, the file in a given folder, or an installed model's file."""
    case = Path(case)
    if case.name == FILE_NAME and case.is_file():
        return case
    path = case / FILE_NAME
    return path if path.is_file() else installed_models().get(str(case), path)


def existing_model_path(case: Path) -> Path:
    """Return the path from `model_path`, or raise a ModelError if no file has this path."""
    path = model_path(case)
    if not path.is_file():
        what = "does not exist"
        if Path(case).is_dir():
            what = f"has no {FILE_NAME}"
        elif Path(case).exists():
            what = "is not a model"
        raise ModelError(
            f"{case} {what}; expected a folder with a {FILE_NAME} that defines model(), a network file (.bif, "
            f".xmlbif, .uai, .net or .xdsl, with or without .gz), or one of {', '.join(installed_models())}"
        )
    return path


def _model_function(path: Path) -> Callable[..., object]:
    spec = importlib.util.spec_from_file_location("rosbayes_case_study_model", path)
    if spec is None or spec.loader is None:
        raise ModelError(f"{path} cannot be loaded as a Python module")
    module: ModuleType = importlib.util.module_from_spec(spec)
    loader = spec.loader
    sys.modules[spec.name] = module  # dataclasses and get_type_hints look up their module
    try:
        _guarded(path, "it", lambda: loader.exec_module(module))
    finally:
        del sys.modules[spec.name]
    function: object = getattr(module, "model", None)
    if not callable(function):
        raise ModelError(
            f"{path} does not define model(); expected a function that returns a toolchain.models.Question"
        )
    return function


def _guarded(path: Path, what: str, call: Callable[[], _Result]) -> _Result:
    """Call a function of the user's file; an exception that it raises becomes one sentence with the file's line.

    A ToolchainError that the file itself raises is unchanged. A ModelError that the toolchain raises, because of a
    call in the file, gets the line of that call.
    """
    try:
        return call()
    except SyntaxError as error:
        raise ModelError(str(error.msg), path=error.filename or path, line=error.lineno or None) from None
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        line, in_toolchain = _line(path, frames), Path(frames[-1].filename).is_relative_to(_TOOLCHAIN)
        if isinstance(error, ModelError) and in_toolchain and line:
            raise ModelError(str(error), path=path, line=line) from None
        if isinstance(error, ToolchainError):
            raise
        if not isinstance(error, SystemExit):
            text = " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())
            raise ModelError(f"{what} raised {text}", path=path, line=line) from error
        if in_toolchain:  # a signal has ended the command, not the file
            raise
        code = "" if error.code is None else f" with {error.code!r}"
        raise ModelError(f"{what} ended the program{code}; expected a model", path=path, line=line) from None


def _line(path: Path, frames: traceback.StackSummary) -> int | None:
    """Return the line of the user's file in which an exception was raised, or None."""
    file = path.resolve()  # Python uses an absolute path, which may still contain a link or `..`
    lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == file]
    return lines[-1] if lines else None


def _arguments(path: Path, function: Callable[..., object], settings: Mapping[str, str]) -> dict[str, Any]:
    parameters = {
        key: parameter
        for key, parameter in inspect.signature(function).parameters.items()
        if parameter.kind not in {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}
    }
    hints = _guarded(path, "an annotation", lambda: get_type_hints(function))
    arguments: dict[str, Any] = {}
    for key, text in settings.items():
        if key not in parameters:
            if not parameters:
                raise ModelError(f"{path}: the model has no parameters, so --set {key} has no meaning")
            raise ModelError(f"{path}: it has no parameter '{key}'; {nearest_name(key, list(parameters))}")
        default = parameters[key].default
        fallback = str if default in {inspect.Parameter.empty, None} else type(default)
        arguments[key] = _value(key, text, hints.get(key, fallback))
    for key, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty and key not in arguments:
            raise ModelError(f"{path}: the model needs {key}: add --set {key}=VALUE")
    return arguments


def _value(key: str, text: str, wanted: Any) -> object:
    """Convert a value to the annotated type of its parameter."""
    # pydantic would compare numbers of a Literal with the text
    choices = get_args(wanted) if get_origin(wanted) is Literal else ()
    value: object = next((choice for choice in choices if str(choice) == text), text)
    try:
        return TypeAdapter(wanted).validate_python(value, strict=False)
    except ValidationError as reason:
        expected = reason.errors()[0]["msg"].removeprefix("Input should be ")
        raise ModelError(f"--set {key}={text}: expected {expected}") from None
    except PydanticUserError:
        raise ModelError(f"--set {key}={text}: it cannot be given on the command line") from None
