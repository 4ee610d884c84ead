"""The one factor that scales every limit of the scripts: TEST_PATIENCE, 1 unless the environment sets it.

No check judges how long something takes. A limit only ends a wait for what never comes, so all are generous.
"""

from __future__ import annotations

import os
from typing import Final

FACTOR: Final = float(os.environ.get("TEST_PATIENCE") or 1)
PRODUCT_LIMITS: Final = {
    "BM_PEER_TIMEOUT": 60 * FACTOR,
    "BM_STOP_TIMEOUT": 20 * FACTOR,
    "BM_SEEN_TIMEOUT": 10 * FACTOR,
    "BM_RESTART_WINDOW": 60 * FACTOR,
}
"""The environment in which stacks are checked, so that a slow machine is not taken for a dead peer."""
