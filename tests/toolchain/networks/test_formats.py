"""A network is the same joint distribution in four formats; mistakes in a file give one sentence with the line.

Dog problem (Charniak 1991): family-out -> light-on, family-out and bowel-problem -> dog-out -> hear-bark.
"""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from toolchain.errors import NetworkFileError
from toolchain.models.distribution import IntegerType, LabelType, Potential
from toolchain.models.model import exact_posterior
from toolchain.networks import MAX_BYTES, SUFFIXES, is_network, read_network

BIF = """\
// The dog problem, in BIF
network "dog problem" { property "credit Charniak; 1991" ; }
variable family-out { type discrete [ 2 ] { true, false }; property position = (1, 2) ; }
variable bowel-problem { type discrete[2] { "true" false }; }
variable dog-out { type discrete [ 2 ] { true, false }; }
variable light-on { type discrete [ 2 ] { true, false }; }
variable hear-bark { type discrete [ 3 ] { <5, >=5, n/a }; }
probability ( family-out ) { table 0.15, 0.85; }
probability ( bowel-problem ) { table 0.01 0.99; } /* no commas
  here, and a comment of two lines: " { */
probability ( dog-out | bowel-problem, family-out ) {
  table 0.99 0.97 0.9 0.3 0.01 0.03 0.1 0.7;
}
probability ( light-on | family-out ) {
  (true) 0.6, 0.4;
  default 0.05, 0.95;
}
probability ( hear-bark | dog-out ) {
  (false) 0.01, 0.98, 0.01;
  (true) 0.7, 2e-1, .1;
}
"""

XMLBIF = """\
<?xml version="1.0" encoding="US-ASCII"?>
<!DOCTYPE BIF [
  <!ELEMENT BIF ( NETWORK )*>
  <!ATTLIST BIF VERSION CDATA #REQUIRED>
]>
<BIF VERSION="0.3"><NETWORK><NAME>Dog-Problem</NAME>
<VARIABLE TYPE="nature"><NAME>family-out</NAME><OUTCOME>true</OUTCOME><OUTCOME>false</OUTCOME></VARIABLE>
<VARIABLE TYPE="nature"><NAME>bowel-problem</NAME><OUTCOME>true</OUTCOME><OUTCOME>false</OUTCOME>
  <PROPERTY>position = (1, 2)</PROPERTY></VARIABLE>
<DEFINITION><FOR>dog-out</FOR><GIVEN>bowel-problem</GIVEN><GIVEN>family-out</GIVEN>
  <TABLE>0.99 0.01 <!-- bowel true, family out --> 0.97 0.03 0.9 0.1 0.3 0.7</TABLE></DEFINITION>
<VARIABLE TYPE="nature"><NAME>dog-out</NAME><OUTCOME>true</OUTCOME><OUTCOME>false</OUTCOME></VARIABLE>
<VARIABLE TYPE="nature"><NAME>light-on</NAME><OUTCOME>true</OUTCOME><OUTCOME>false</OUTCOME></VARIABLE>
<VARIABLE TYPE="nature"><NAME>hear-bark</NAME><OUTCOME>&lt;5</OUTCOME><OUTCOME>>=5</OUTCOME>
  <OUTCOME>n/a</OUTCOME></VARIABLE>
<DEFINITION><FOR>family-out</FOR><TABLE>0.15 0.85</TABLE></DEFINITION>
<DEFINITION><FOR>bowel-problem</FOR><TABLE>0.01 0.99</TABLE></DEFINITION>
<DEFINITION><FOR>light-on</FOR><GIVEN>family-out</GIVEN><TABLE>0.6 0.4 0.05 0.95</TABLE></DEFINITION>
<DEFINITION><FOR>hear-bark</FOR><GIVEN>dog-out</GIVEN><TABLE>0.7 2e-1 .1 0.01 0.98 0.01</TABLE></DEFINITION>
</NETWORK></BIF>
"""

NET = """\
% The dog problem, in Hugin's format
net { node_size = (80 40); comment = "a } in a string"; }
node family_out { states = ("true" "false"); label = "50% out"; position = (100 100); }
node bowel_problem { states = ("true" "false"); }
discrete node dog_out { states = ( "true" "false" ); subtype = boolean; }
node light_on { states = ("true" "false"); }
node hear_bark { states = ("<5" ">=5" "n/a"); }
potential ( family_out ) { data = ( 0.15 0.85 ); }
potential ( bowel_problem | ) { data = ( 0.01 0.99 ); }
potential ( dog_out | bowel_problem family_out )
{ data = ((( 0.99 0.01 )   % bowel_problem=true, family_out=true
           ( 0.97 0.03 ))
          (( 0.9 0.1 )
           ( 0.3 0.7 ))); }
potential ( light_on | family_out ) { data = ((0.6 0.4)(0.05 0.95)); experience = (1 2); }
potential ( hear_bark | dog_out ) { data = ((0.7 0.2 0.1)(0.01 0.98 0.01)); }
"""

UAI = """\
BAYES
5
2 2 2 2 3
5
1 0  # family-out
1 1
3 1 0 2
2 0 3
2 2 4
2  0.15 0.85
2  0.01 0.99
8
0.99 0.01 0.97 0.03
0.9 0.1 0.3 0.7
4  0.6 0.4 0.05 0.95
6  0.7 0.2 0.1 0.01 0.98 0.01
"""

XDSL = """\
<?xml version="1.0" encoding="UTF-8"?>
<smile version="1.0" id="Network1" numsamples="10000">
  <nodes>
    <cpt id="family_out"><state id="true"/><state id="false"/><probabilities>0.15 0.85</probabilities></cpt>
    <cpt id="bowel_problem"><state id="true"/><state id="false"/>
      <probabilities>0.01 0.99</probabilities></cpt>
    <cpt id="dog_out"><state id="true" /><state id="false" /><parents>bowel_problem family_out</parents>
      <probabilities>0.99 0.01 0.97 0.03 0.9 0.1 0.3 0.7</probabilities></cpt>
    <cpt id="light_on"><state id="true"/><state id="false"/><parents>family_out</parents>
      <probabilities>0.6 0.4 0.05 0.95</probabilities></cpt>
    <cpt id="hear_bark"><state id="&lt;5"/><state id=">=5"/><state id="n/a"/><parents>dog_out</parents>
      <probabilities>0.7 2e-1 .1 0.01 0.98 0.01</probabilities></cpt>
  </nodes>
  <extensions><genie version="1.0" app="GeNIe"><node id="dog_out"><name>Dog out</name></node></genie></extensions>
</smile>
"""

TEXTS = {"dog.bif": BIF, "dog.xmlbif": XMLBIF, "dog.net": NET, "dog.uai": UAI, "dog.xdsl": XDSL}
NAMES = ("family-out", "bowel-problem", "dog-out", "light-on", "hear-bark")


def read(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_network(path)


def names_in(file):
    """The variables' names as the format can write them."""
    if file.endswith(".uai"):
        return ("0", "1", "2", "3", "4")
    return tuple(name.replace("-", "_") for name in NAMES) if file.endswith((".net", ".xdsl")) else NAMES


@pytest.mark.parametrize("file", TEXTS)
def test_the_same_network_in_every_format(tmp_path, file):
    joint = read(tmp_path, file, TEXTS[file])
    names = names_in(file)
    assert {symbol.name for symbol in joint.symbols} == set(names)
    factors = {factor.symbol.name: factor for factor in joint.factors}
    family, bowel, dog, light, bark = (factors[name] for name in names)
    assert family.table.tolist() == [0.15, 0.85]
    assert bowel.table.tolist() == [0.01, 0.99]
    assert [symbol.name for symbol in dog.given] == [names[1], names[0]]
    assert dog.table == pytest.approx(np.array([[[0.99, 0.97], [0.9, 0.3]], [[0.01, 0.03], [0.1, 0.7]]]))
    assert light.table == pytest.approx(np.array([[0.6, 0.05], [0.4, 0.95]]))
    assert bark.table == pytest.approx(np.array([[0.7, 0.01], [0.2, 0.98], [0.1, 0.01]]))
    labels = IntegerType(0, 2) if file.endswith(".uai") else LabelType("<5", ">=5", "n/a")
    assert joint.symbol(names[4]).type == labels
    # P(family-out | light-on, hear-bark): the two are independent given family-out, and so this is a BM1's
    model = joint.ask([names[0]], [names[3], names[4]]).model()
    out, at_home = 0.01 * 0.99 + 0.99 * 0.9, 0.01 * 0.97 + 0.99 * 0.3  # P(dog-out | family-out, or not)
    odds = (
        0.15 * 0.6 * (0.7 * out + 0.01 * (1 - out)) / (0.85 * 0.05 * (0.7 * at_home + 0.01 * (1 - at_home)))
    )
    assert exact_posterior(model, [0, 0])[0] == pytest.approx(odds / (1 + odds))


@pytest.mark.parametrize(
    ("file", "text", "name"),
    [
        ("dog.bif", BIF, "dog problem"),
        ("dog.xmlbif", XMLBIF, "Dog-Problem"),
        ("dog.net", NET, "dog"),
        ("dog.net", "class Dogs {\ninheritance = ();\n" + NET.split("\n", 2)[2] + "}\n", "Dogs"),
        ("dog.bif", BIF.replace('"dog problem"', "unknown"), "dog"),
        ("dog.bif.gz", gzip.compress(BIF.replace('"dog problem"', "unknown").encode()), "dog"),
        ("dog.xdsl", XDSL, "Network1"),
        ("dog.bif", BIF.replace("/* no commas", "/* */ /* no commas"), "dog problem"),
        ("dog.bif", BIF.replace("0.15, 0.85", "0.15, 0.849"), "dog problem"),
    ],
)
def test_a_network_has_a_name_and_probabilities_that_sum_to_1(tmp_path, file, text, name):
    joint = read(tmp_path, file, text)
    assert joint.name == name
    for factor in joint.factors:
        assert factor.table.sum(axis=0) == pytest.approx(1, abs=1e-15)


def test_a_markov_network(tmp_path):
    joint = read(tmp_path, "m.uai", "c a comment\nMARKOV 3\n2 2 2\n2\n2 0 1\n2 1 2\n4 1 2 3 4\n4\n5 6 7 8\n")
    assert all(isinstance(factor, Potential) for factor in joint.factors)
    assert joint.factors[1].table.tolist() == [[5, 6], [7, 8]]
    assert joint.ask(["1"], ["0", "2"]).model().prior_distribution == pytest.approx([44 / 134, 90 / 134])


def changed(file, old, new):
    assert old in TEXTS[file], old
    return file, TEXTS[file].replace(old, new, 1)


def test_deterministic_nodes_of_xdsl_whose_parents_follow(tmp_path):
    text = """<smile id="either"><nodes>
      <deterministic id="either"><state id="yes"/><state id="no"/><parents>a b</parents>
        <resultingstates>yes no no no</resultingstates></deterministic>
      <cpt id="a"><state id="yes"/><state id="no"/><probabilities>0.2 0.8</probabilities></cpt>
      <cpt id="b"><state id="yes"/><state id="no"/><probabilities>0.5 0.5</probabilities></cpt>
    </nodes></smile>"""
    joint = read(tmp_path, "either.xdsl", text)
    assert joint.factors[0].table.tolist() == [[[1, 0], [0, 0]], [[0, 1], [1, 1]]]
    assert joint.ask(["either"]).model().prior_distribution == pytest.approx([0.1, 0.9])


ASIA_OF_PGMPY = """\
BAYES
8
2 2 2 2 2 2 2 2
8
1 0
2 5 1
3 3 1 2
3 6 4 3
2 5 4
1 5
2 0 6
2 3 7

2
0.01 0.99
4
0.6 0.3 0.4 0.7
8
0.9 0.8 0.7 0.1 0.1 0.2 0.3 0.9
8
1.0 1.0 1.0 0.0 0.0 0.0 0.0 1.0
4
0.1 0.01 0.9 0.99
2
0.5 0.5
4
0.05 0.01 0.95 0.99
4
0.98 0.05 0.02 0.95"""
"""The network asia as pgmpy 1.1.2 writes it; 2 is dysp, whose parents are 1, bronc, and 3, either."""


def test_a_uai_file_of_pgmpy_has_the_first_variable_fastest(tmp_path):
    factors = {factor.symbol.name: factor for factor in read(tmp_path, "asia.uai", ASIA_OF_PGMPY).factors}
    assert [symbol.name for symbol in factors["2"].given] == ["3", "1"]
    assert factors["2"].table[0].tolist() == [[0.9, 0.7], [0.8, 0.1]]  # [either, bronc]
    assert factors["6"].table.tolist() == [[0.05, 0.01], [0.95, 0.99]]
    standard = UAI.replace("0.99 0.01 0.97 0.03\n0.9 0.1 0.3 0.7", "0.99 0.97 0.9 0.3 0.01 0.03 0.1 0.7")
    with pytest.raises(NetworkFileError, match="sum to") as caught:  # the other tables are not in that order
        read(tmp_path, "dog.uai", standard)
    assert caught.value.line == 14


def test_compressed_files_are_bounded(tmp_path):
    assert is_network(tmp_path / "dog.bif.gz")
    assert not is_network(tmp_path / "dog.gz")
    packed = gzip.compress(BIF.encode())
    assert read(tmp_path, "dog.bif.gz", packed).name == "dog problem"
    for data in (packed[:-12], b"", b"no gzip", packed[:20] + b"\0" + packed[21:]):
        with pytest.raises(NetworkFileError):
            read(tmp_path, "dog.bif.gz", data)
    with pytest.raises(NetworkFileError, match="unpacked"):
        read(tmp_path, "dog.bif.gz", gzip.compress(b" " * (MAX_BYTES + 1)))


PROBABILITIES = (
    *("0.15, 1_0", "0.15, 0.84, 0.01", "0.15, 0.8, 0.01, 0.03, 0.01"),
    *("0.15", "0.15, 0.82", "-0.15, 1.15", "nan, 0.85"),
)
ENTITIES = (
    *('<!ENTITY a "aaaaaaaaaa">', '<!ENTITY e SYSTEM "file:///etc/passwd">'),
    '<!ENTITY % p SYSTEM "http://127.0.0.1/x"> %p;',
)
MISTAKES = [
    (*changed("dog.xdsl", '<cpt id="light_on">', '<noisymax id="x"/><cpt id="light_on">'), 9),
    (*changed("dog.xdsl", "0.6 0.4 0.05", "0.6 0.4"), 10),
    (*changed("dog.xdsl", "0.6 0.4 0.05", "0.6 0.4 0.0_5"), 10),
    (*changed("dog.xdsl", "<parents>family_out", "<parents>family"), 10),
    (*changed("dog.xdsl", "</smile>", ""), 16),
    (*changed("dog.xdsl", '<cpt id="light_on">', '<cpt dynamic="plate" id="light_on">'), 9),
    (*changed("dog.xdsl", "0.05 0.95</probabilities>", "0.05 0.95</probabilities><probabilities/>"), 10),
    (*changed("dog.xdsl", "<parents>family_out", f"<parents>{'p ' * 31}family_out"), 10),
    ("dog.xdsl", "<smile><cpt id='a'><state id='b'/><parents>c</parents></cpt></smile>", None),
    (*changed("dog.xdsl", "<smile", '<!DOCTYPE smile [<!ENTITY a "b">]><smile'), 2),
    *((*changed("dog.bif", "table 0.15, 0.85", f"table {new}"), 8) for new in PROBABILITIES),
    *((*changed("dog.xmlbif", "<!ELEMENT BIF ( NETWORK )*>", new), 3) for new in ENTITIES),
    (*changed("dog.bif", "variable dog-out", "varable dog-out"), 5),
    (*changed("dog.bif", "[ 3 ]", "[ 4 ]"), 7),
    (*changed("dog.bif", "{ <5, >=5, n/a }", "{ a, a, b }"), 7),
    (*changed("dog.bif", "variable light-on", "variable dog-out"), 6),
    (*changed("dog.bif", "table 0.15, 0.85;", "table 0.15, 0.85; table 0.85, 0.15;"), 8),
    (*changed("dog.bif", "default 0.05, 0.95;", "default 0.05, 0.95; default 0.5, 0.5;"), 16),
    (*changed("dog.bif", "variable dog-out", 'variable "dog\x1b[2J"'), 5),
    (*changed("dog.bif", "default 0.05, 0.95;", ""), 17),
    (*changed("dog.bif", "(false) 0.01", "(maybe) 0.01"), 19),
    (*changed("dog.bif", "(true) 0.7, 2e-1, .1", "(false) 0.7, 0.2, 0.1"), 20),
    (*changed("dog.bif", "(true) 0.7", "(true, true) 0.7"), 20),
    (*changed("dog.bif", "bowel-problem, family-out", "family-out, family-out"), 11),
    (*changed("dog.bif", "probability ( light-on |", "probability ( dog-out |"), 17),
    (*changed("dog.bif", 'lines: " { */', "lines:"), 9),
    (*changed("dog.bif", '"dog problem"', '"dog problem'), 2),
    ("dog.bif", "", None),
    ("dog.bif", BIF.split("probability", 1)[0], None),
    ("dog.bif", BIF.encode() + b"\xff", 22),
    (*changed("dog.xmlbif", "0.15 0.85", "0.15"), 16),
    (*changed("dog.xmlbif", "<FOR>family-out</FOR>", ""), 16),
    (*changed("dog.xmlbif", "<FOR>family-out</FOR>", "<FOR>x</FOR>"), 16),
    (*changed("dog.xmlbif", 'TYPE="nature"', 'TYPE="decision"'), 7),
    (*changed("dog.xmlbif", "US-ASCII", "nonsense"), 1),
    ("dog.xmlbif", "<BIF>" * 40, 1),
    ("dog.xmlbif", "<html/>", 1),
    (*changed("dog.net", "node light_on", "utility light_on"), 6),
    (*changed("dog.net", 'states = ("true" "false"); label', "label"), 3),
    (*changed("dog.net", "data = ( 0.15 0.85 );", ""), 8),
    (*changed("dog.net", "( 0.15 0.85 )", "(( 0.15 0.85 )"), 8),
    (*changed("dog.net", "dog_out | bowel", "dog_out bowel"), 10),
    ("dog.net", NET + "class A { class B {", 17),
    (*changed("dog.uai", "BAYES", "BAYESIAN"), 1),
    (*changed("dog.uai", "8\n0.99", "9\n0.99"), 12),
    ("dog.uai", UAI + "7", 17),
    ("dog.uai", "BAYES 1 99999999", 1),
    ("dog.uai", "BAYES 3 60000 60000 2 1 3 0 1 2", 1),
    ("dog.uai", "MARKOV 2 2 2 1 1 0 2 1 1", None),
    ("dog.uai", "MARKOV 1 2 1 1 0 2 1 -1", 1),
]


@pytest.mark.parametrize(("file", "text", "line"), MISTAKES)
def test_a_mistake_is_one_sentence_with_the_file_and_the_line(tmp_path, file, text, line):
    with pytest.raises(NetworkFileError) as caught:
        read(tmp_path, file, text)
    assert (caught.value.path, caught.value.line) == (tmp_path / file, line)
    assert str(caught.value).startswith(f"{tmp_path / file}")
    assert "\n" not in str(caught.value)


def test_files_that_are_not_networks_or_too_large(tmp_path):
    with pytest.raises(NetworkFileError):
        read(tmp_path, "dog.csv", BIF)
    assert is_network(Path("a/B.BIF"))
    assert not is_network(Path("a/model.py"))
    with (tmp_path / "long.bif").open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(NetworkFileError):
        read_network(tmp_path / "long.bif")


@pytest.mark.parametrize(
    "text",
    [
        "/*" * 400_000,
        '"' * 400_000,
        "network a {" + "(" * 400_000,
        "variable a { type discrete [ 2 ] { " + "a " * 400_000,
        "probability ( a | " + "b, " * 400_000,
        "a" * 800_000,
        BIF + "probability ( dog-out ) { table " + "1 " * 400_000 + "; }",
    ],
    ids=["comments", "quotes", "brackets", "states", "parents", "word", "numbers"],
)
def test_long_nonsense_is_refused_without_taking_long(tmp_path, text):
    with pytest.raises(NetworkFileError) as caught:
        read(tmp_path, "long.bif", text)
    assert len(str(caught.value)) < 600 + len(str(tmp_path))


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(TEXTS)), st.data())
def test_a_damaged_file_is_read_or_refused(tmp_path, file, data):
    text = TEXTS[file].encode()
    at = data.draw(st.integers(0, len(text) - 1))
    length = data.draw(st.integers(0, 40))
    put = data.draw(
        st.binary(max_size=6) | st.sampled_from([b"", b"{", b"}", b"(", b")", b";", b'"', b"|", b"<", b"9"])
    )
    damaged = text[:at] + put + text[at + length :]
    if data.draw(st.booleans()):
        damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
    try:
        read(tmp_path, file, damaged)
    except NetworkFileError as error:
        assert re.match(re.escape(str(tmp_path / file)), str(error))
        assert "\n" not in str(error)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([*SUFFIXES, ".bif.gz"]), st.binary(max_size=60), st.booleans())
def test_any_bytes_are_one_error(tmp_path, suffix, data, packed):
    path = tmp_path / f"any{suffix}"
    path.write_bytes(gzip.compress(data) if packed and suffix.endswith(".gz") else data)
    with pytest.raises(NetworkFileError) as caught:
        read_network(path)
    assert "\n" not in str(caught.value)
