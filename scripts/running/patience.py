"""The factor that scales all time limits of the scripts: TEST_PATIENCE, 1 unless the environment sets it.

No check judges how long something takes. A limit only ends a wait for an event that never comes, so all are generous.
"""

import os
from typing import Final

FACTOR: Final = float(os.environ.get("TEST_PATIENCE") or 1)
PRODUCT_LIMITS: Final = {
    "BM_PEER_TIMEOUT": 60 * FACTOR,
    "BM_STOP_TIMEOUT": 20 * FACTOR,
    "BM_SEEN_TIMEOUT": 10 * FACTOR,
    "BM_RESTART_WINDOW": 60 * FACTOR,
}
"""Environment variables for the checked stacks, so that a slow machine is not mistaken for a dead peer."""
