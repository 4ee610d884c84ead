"""MIFs: written files are read back, every form is accepted, and a mistake gives a sentence with its line."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolchain.errors import MifError
from toolchain.outputs.mif import Mif, mif_lines, parse_mif, read_mif

HEAD = "WIDTH=8; DEPTH=8; ADDRESS_RADIX=HEX; DATA_RADIX=HEX;\nCONTENT BEGIN\n"


def mif_text(mif, comments=()):
    return "".join(mif_lines(mif.width, len(mif.words), mif.words, comments))


@st.composite
def memories(draw):
    width = draw(st.sampled_from([1, 3, 8, 12, 32, 57, 64, 130, 4096]))
    return Mif(width, tuple(draw(st.lists(st.integers(0, 2**width - 1), min_size=1, max_size=300))))


@given(memories(), st.lists(st.text(), max_size=3))
def test_what_is_written_is_read(memory, comments):
    text = mif_text(memory, comments)
    assert text.isascii()
    assert parse_mif(text) == memory


def test_the_canonical_form():
    assert mif_text(Mif(10, (0, 1023, 5)), ["a\nb é"]) == (
        "-- a\\nb \\xe9\nWIDTH=10;\nDEPTH=3;\nADDRESS_RADIX=HEX;\nDATA_RADIX=HEX;\nCONTENT BEGIN\n"
        "0 : 000;\n1 : 3FF;\n2 : 005;\nEND;\n"
    )


@given(
    st.data(),
    st.sampled_from(["BIN", "OCT", "DEC", "HEX", "UNS"]),
    st.sampled_from(["BIN", "OCT", "DEC", "HEX", "UNS"]),
)
def test_every_form_is_read(data, address_radix, data_radix):
    """A memory cut into runs, ranges and single words, in any radix, with comments between."""
    words = data.draw(st.lists(st.integers(0, 255), min_size=1, max_size=40))
    shape = {"BIN": "b", "OCT": "o", "DEC": "d", "HEX": "x", "UNS": "d"}

    def spoken(number):
        if data_radix == "DEC" and number >= 128 and data.draw(st.booleans()):
            return str(number - 256)
        return data.draw(st.sampled_from(["", "00"])) + format(number, shape[data_radix])

    def gap():
        return data.draw(st.sampled_from([" ", "\n", "\t", " -- 1 : 2;\n", " %8 : %", "%\n%\r\n"]))

    text = f"depth{gap()}={gap()}{len(words)};Width = 8 ; DATA_RADIX={data_radix};ADDRESS_RADIX = {address_radix.lower()};"
    text += f"{gap()}content{gap()}Begin{gap()}"
    at = 0
    while at < len(words):
        run = words[at : at + data.draw(st.integers(1, 6))]
        first, last = (format(end, shape[address_radix]) for end in (at, at + len(run) - 1))
        if data.draw(st.booleans()):
            said = run[:1] if len(set(run)) == 1 else run
            text += f"[{gap()}{first}{gap()}..{gap()}{last}{gap()}]{gap()}:"
        else:
            said = run
            text += f"{first}{gap()}:"
        text += gap() + gap().join(spoken(word) for word in said) + f"{gap()};{gap()}"
        at += len(run)
    assert parse_mif(text + data.draw(st.sampled_from(["END;", "end ;\n", "END"]))) == Mif(8, tuple(words))


def test_what_is_left_out_is_zero_hexadecimal_is_the_default_and_words_of_a_range_are_repeated():
    assert parse_mif("DEPTH=12;WIDTH=8;CONTENT BEGIN A:10; END;").words == (0,) * 10 + (16, 0)
    assert parse_mif(HEAD + "[1..5] : 1 2;\nEND;").words == (0, 1, 2, 1, 2, 1, 0, 0)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", 1),
        ("\n\nWITH=3;", 3),
        ("WIDTH=8;\nCONTENT BEGIN", 2),
        ("WIDTH=8;\nWIDTH=8;", 2),
        ("WIDTH=0;", 1),
        ("WIDTH=99999999999; DEPTH=1; CONTENT BEGIN END;", 1),
        ("DEPTH=" + "9" * 5000, 1),
        ("DATA_RADIX=ROMAN;", 1),
        ("WIDTH=8; DEPTH=8;\nCONTENT\nBEGUN", 3),
        (HEAD + "0 : 1;\n", 4),
        (HEAD + "0 : 100;", 3),
        (HEAD + "0 : 1_0;", 3),
        (HEAD + "0 : G;", 3),
        (HEAD + "8 : 1;", 3),
        (HEAD + "6 : 1 2\n3;", 4),
        (HEAD + "0 : " + "1 " * 9, 3),
        (HEAD + "0 : 1;\n[0..2] : 1;", 4),
        (HEAD + "[3..2] : 1;", 3),
        (HEAD + "[3,2] : 1;", 3),
        (HEAD + "% never\n ends", 3),
        (HEAD + "END;\n0 : 1;", 4),
        ("WIDTH=8; DEPTH=1; DATA_RADIX=DEC; CONTENT BEGIN 0 : -129; END;", 1),
    ],
)
def test_mistakes(text, line):
    with pytest.raises(MifError) as caught:
        parse_mif(text, "a.mif")
    assert str(caught.value).startswith("a.mif, line ")
    assert caught.value.line == line


@given(st.text(alphabet="WIDTHEPCON=8;:[]. 01A%-\n"))
def test_noise_is_refused_or_read_but_never_fails_otherwise(noise):
    with suppress(MifError):
        parse_mif(HEAD + noise)


def test_a_file(tmp_path):
    (tmp_path / "a.mif").write_bytes(b"-- \xe9\xff\n" + mif_text(Mif(4, (1, 2))).encode())
    assert read_mif(tmp_path / "a.mif") == Mif(4, (1, 2))
    with pytest.raises(MifError, match="No such file"):
        read_mif(tmp_path / "b.mif")
