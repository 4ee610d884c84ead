"""Generics of the guard in its bench and in its proof."""

from typing import Final

REPLICAS: Final = 3
GENERICS: Final = {
    "REPLICAS": REPLICAS,
    "COUNTER_BITS": 8,
    "PRIOR_BITS": 2,
    "BANKS": 5,
    "SENSORS_DEPTH": 0,
    "INPUTS_DEPTH": 9,
    "PRIOR_SELECTS_DEPTH": REPLICAS,
    "OUTCOMES_DEPTH": 4 * REPLICAS,
    "RESULTS_DEPTH": 12,
    "PRIOR_CODES_DEPTH": 0,
}
