"""UAI, a network of only numbers, BAYES or MARKOV; its variables are named 0, 1, 2 and so on."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, MAX_VARIABLES, ROUNDING, NetworkBuilder
from toolchain.networks.scanner import Scanner

_MAX_FACTORS: Final = 4 * MAX_VARIABLES
_COMMENTS: Final = r"#[^\n]*|(?m:^c\b[^\n]*)"


def read_uai(data: bytes, builder: NetworkBuilder) -> None:
    """Read a UAI file: a preamble (kind, sizes, variables of each factor), then the numbers of each factor.

    The last variable of a factor varies fastest; in a BAYES file it is the child. (pyagrum 3.3.1 writes the
    first parent fastest, contrary to the format.)

    Raises:
        NetworkFileError: The file is not UAI; the sentence contains the line and the expected token.
    """
    text = Scanner(data, builder.path, comments=_COMMENTS)
    kind = text.word("BAYES or MARKOV")
    if kind not in {"BAYES", "MARKOV"}:
        raise text.error(f"expected BAYES or MARKOV, found {kind[:40]!r}")
    variables = text.count("the number of variables", MAX_VARIABLES)
    for number in range(variables):
        builder.variable(str(number), text.count("a variable's size", MAX_STATES), text)
    factors = text.count("the number of factors", _MAX_FACTORS)
    scopes = []
    for _ in range(factors):
        size = text.count("a factor's number of variables", MAX_PARENTS + 1)
        scopes.append(tuple(str(text.count("a variable", variables - 1)) for _ in range(size)))
    for number, scope in enumerate(scopes):
        what = f"factor {number}"
        shape = builder.shape(scope, text)
        given = text.count(f"the number of entries of {what}", 10**9 - 1)
        if given != math.prod(shape):
            raise text.error(f"{what} is to have {given} entries, but its variables make {math.prod(shape)}")
        values = text.next_numbers(given, what).reshape(shape)
        if kind == "BAYES" and scope:
            _check_order(scope[-1], values, text)
            builder.distribution(scope[-1], scope[:-1], np.moveaxis(values, -1, 0), text)
        else:
            builder.potential(scope, values, text)
    if rest := text.next():
        raise text.error(f"expected the end of the file after the last factor, found {rest[:40]!r}")


def _check_order(child: str, values: NDArray[np.float64], text: Scanner) -> None:
    """Refuse a table that is a distribution only if the child, last in its scope, varies slowest."""
    flat = values.ravel()
    fastest, slowest = (
        flat.reshape(-1, values.shape[-1]).sum(axis=1),
        flat.reshape(values.shape[-1], -1).sum(axis=0),
    )
    if not np.allclose(fastest, 1, atol=ROUNDING) and np.allclose(slowest, 1, atol=ROUNDING):
        raise text.error(
            f"the table of {child} sums to 1 only if {child} varies slowest, as pgmpy writes UAI files; in the format it "
            "varies fastest: save the network as BIF instead"
        )
