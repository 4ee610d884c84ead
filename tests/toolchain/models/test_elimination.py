"""Variable elimination: exact sums in the cheaper of two orders, and a refusal if both are too large."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolchain.errors import ModelError
from toolchain.models import inference
from toolchain.models.inference import Term, eliminate, product


def random_network(seed):
    """Terms of a random directed graph of 8 to 13 names, with sizes of 2 to 5."""
    random, numbers = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    names = [f"v{at}" for at in range(random.integers(8, 14))]
    sizes = {name: int(random.integers(2, 6)) for name in names}
    terms = []
    for at, name in enumerate(names):
        count = min(at, int(random.integers(1, 3)))
        parents = [names[each] for each in random.choice(at, count, replace=False)] if count else []
        scope = (name, *parents)
        terms.append(Term(scope, numbers.random([sizes[each] for each in scope])))
    return terms, names, sizes


def summed(terms, names, sizes, kept):
    """The answer by inference, and by one sum over everything; both normalised."""
    left = eliminate(terms, [name for name in names if name not in kept], sizes)
    found = product(left, kept, sizes)
    letters = {name: chr(ord("a") + at) for at, name in enumerate(names)}
    scopes = ",".join("".join(letters[name] for name in term.scope) for term in terms)
    whole = np.einsum(
        f"{scopes}->{''.join(letters[name] for name in kept)}", *(term.table for term in terms), optimize=True
    )
    return found / found.sum(), whole / whole.sum()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_it_is_the_sum(seed, both_orders):
    terms, names, sizes = random_network(seed)
    with pytest.MonkeyPatch.context() as patch:
        if both_orders:
            patch.setattr(inference, "_CHEAP", 0)
        found, whole = summed(terms, names, sizes, [names[0], names[-1]])
    assert found == pytest.approx(whole)


def test_min_fill_answers_what_smallest_tables_would_refuse(monkeypatch):
    terms, names, sizes = random_network(2964)  # the largest tables have 1600 and 480 entries
    monkeypatch.setattr(inference, "MAX_ENTRIES", 1000)
    monkeypatch.setattr(inference, "_CHEAP", 10**9)
    with pytest.raises(ModelError, match="summing over"):
        summed(terms, names, sizes, [names[0], names[-1]])
    monkeypatch.setattr(inference, "_CHEAP", 100)
    found, whole = summed(terms, names, sizes, [names[0], names[-1]])
    assert found == pytest.approx(whole)


def test_if_both_orders_are_too_large_the_table_is_named(monkeypatch):
    terms, names, sizes = random_network(2964)
    monkeypatch.setattr(inference, "MAX_ENTRIES", 100)
    monkeypatch.setattr(inference, "_CHEAP", 0)
    with pytest.raises(ModelError, match=r"summing over v\d+ needs a table of \d+ entries"):
        summed(terms, names, sizes, [names[0], names[-1]])


def test_a_name_with_thousands_of_neighbours():
    sizes = {f"leaf{at}": 2 for at in range(2000)} | {"hub": 2}
    terms = [Term((name, "hub"), np.ones((2, 2))) for name in sizes if name != "hub"]
    (left,) = eliminate(terms, sizes, sizes)
    assert left.table > 0
