"""Results as `master` prints them: the words and the keys of `listen`."""

import json

import pytest

from services.output.axes import axes_of
from services.output.master_output import print_json, sentence
from services.output.posterior_file import record
from services.output.posterior_lines import line
from services.sockets.records import Outcome, Published
from tests.services.output.test_posterior_output import deployment, made
from toolchain.deployment import Dimension

MAP = deployment(
    Dimension(label="y", size=2, offset=0.5, step=2.0, unit="m"),
    Dimension(label="size", size=3, states=("small", "medium", "large")),
)
POSTERIOR = made([[0, 0, 2], [1, 0, 1]], "y", "size")


@pytest.fixture
def result():
    published = Published(
        number=7,
        outcome=Outcome.PUBLISHED,
        seen=True,
        best_line=2,
        best_probability=0.5,
        cycles=812,
        total_ns=3_210_000,
    )
    return published, MAP


def test_the_line_of_a_master_begins_with_the_words_of_listen(result):
    said = sentence(*result)
    assert said == "frame 7: y 0.5 m, size large with 0.5; 812 cycles; 3.21 ms"
    heard = line(POSTERIOR, axes_of(POSTERIOR, MAP))
    assert heard == said.replace("with 0.5;", "with 0.5; mean y 1.5 m;")


def test_best_means_the_same_in_both_objects(result, capfdbinary):
    print_json(*result)
    said = json.loads(capfdbinary.readouterr().out)
    heard = record(POSTERIOR, axes_of(POSTERIOR, MAP))
    assert said["best"] == {"y": 0, "size": 2}
    assert list(said["best"]) == ["y", "size"]
    for key in ("best", "best_value", "probability"):
        assert said[key] == heard[key]
