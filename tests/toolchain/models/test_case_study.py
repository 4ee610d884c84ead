"""A user's model.py: found, called with --set values, and every mistake in it a sentence with its line."""

import sys
import textwrap
from pathlib import Path

import pytest

from toolchain.errors import ModelError
from toolchain.models.case_study import load_model

MODEL = """
from enum import Enum
from pathlib import Path
from typing import Literal
import numpy as np
from toolchain.models import Known, Model, dimension

class Kind(Enum):
    COARSE = "coarse"
    FINE = "fine"

def model(size: int = 4, share: float = 0.5, name: str = "tiny", file: Path | None = None, flat: bool = True,
          kind: Kind = Kind.FINE, mode: Literal["a", 2] = "a", plain=3, table: dict | None = None) -> Model:
    known = Known(name="K", table=np.array([[share] * size, [1 - share] * size]))
    words = f"{name} {type(file).__name__} {flat} {kind.name} {mode!r} {plain!r}"
    return Model(name=words, searched=(dimension("s", size=size),), known=(known,))
"""


@pytest.fixture
def case(tmp_path):
    def write(text=MODEL):
        (tmp_path / "model.py").write_text(textwrap.dedent(text))
        return tmp_path

    return write


def test_values_are_read_as_their_parameters_types(case):
    default = load_model(case() / "model.py", {})
    assert (default.lines, default.name) == (4, "tiny NoneType True FINE 'a' 3")
    settings = {"size": "3", "share": "0.25", "name": "12", "file": "x.csv", "flat": "No"}
    model = load_model(case(), settings | {"kind": "coarse", "mode": "2", "plain": "7"})
    assert model.lines == 3
    assert model.known[0].table[0, 0] == 0.25
    assert model.name == f"12 {type(Path()).__name__} False COARSE 2 7"


def test_a_mistake_has_its_line_however_the_folder_is_named(case, tmp_path, monkeypatch):
    case("def model():\n    return 1 / 0")
    (tmp_path / "beside").mkdir()
    (tmp_path / "link").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path / "beside")
    for folder in ("..", "../link", "../beside/.."):
        with pytest.raises(ModelError, match=r"model\.py, line 2: model\(\) raised ZeroDivisionError"):
            load_model(Path(folder), {})


@pytest.mark.parametrize(
    "settings",
    [
        {"siz": "3"},
        {"size": "3.5"},
        {"plain": "x"},
        {"share": "half"},
        {"flat": "maybe"},
        {"kind": "fin"},
        {"mode": "b"},
        {"table": "{}"},
        {"size": "0"},
    ],
)
def test_wrong_settings(case, settings):
    with pytest.raises(ModelError) as caught:
        load_model(case(), settings)
    assert caught.value.exit_code == 2
    with pytest.raises(ModelError, match="has no parameters"):
        load_model(case("def model():\n    pass"), settings)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def model(file):\n    pass", None),
        ("def model():\n    raise ValueError('a\\nb')", 2),
        ("import sys\nsys.exit(3)", 2),
        ("def model():\n    raise SystemExit", 2),
        ("def model(*sizes):\n    return sizes", None),
        ("\nimport nowhere_to_be_found", 2),
        ("def model(:\n", 1),
        ("\x7fELF\0\0", None),
        ("x = 1", None),
        ("def model():\n    return 5", None),
        ("def model():\n    pass", None),
        ("def model(x: 'Nonsense' = 1):\n    pass", None),
        ("from toolchain.models import *\n\ndef model():\n    return IntegerType(3, 2)", 4),
    ],
)
def test_mistakes_in_the_file(case, text, line):
    folder = case(text)
    with pytest.raises(ModelError) as caught:
        load_model(folder, {})
    assert caught.value.line == line
    assert str(folder / "model.py") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_folder_and_no_model(tmp_path):
    with pytest.raises(ModelError, match=r"has no model\.py"):
        load_model(tmp_path, {})
    with pytest.raises(ModelError, match="does not exist; .* boat, disparity, mrclam, sprinkler$"):
        load_model(tmp_path / "nowhere", {})


def test_an_installed_model_has_a_name_that_a_folder_with_a_model_takes_over(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    boat, small = Path("boat"), {"width": "4", "height": "4"}
    assert load_model(boat, small).lines == 16
    boat.mkdir()  # of a deployment, for example
    assert load_model(boat, small).lines == 16
    case(MODEL.replace("size: int = 4", "size: int = 5")).joinpath("model.py").rename(boat / "model.py")
    assert load_model(boat, {}).lines == 5


def test_a_module_beside_the_model_can_be_imported_and_nothing_stays_behind(case):
    folder = case("import beside_the_model\n" + MODEL)
    (folder / "beside_the_model.py").write_text("")
    before = list(sys.path)
    assert load_model(folder, {}).lines == 4
    assert sys.path == before


def test_what_a_model_is_written_with_comes_from_one_place():
    import toolchain.models

    for name in toolchain.models.__all__:
        assert getattr(toolchain.models, name).__name__ == name
    with pytest.raises(ImportError, match="nothing_such"):
        from toolchain.models import nothing_such  # noqa: F401 - it does not exist
