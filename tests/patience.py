"""The one factor that scales every limit of the tests: TEST_PATIENCE, 1 unless the environment sets it.

No test judges how long something takes. A limit only names the test that hangs, so all are generous.
"""

from scripts.running.patience import FACTOR

PATIENCE = 50.0 * FACTOR
"""Seconds that a test waits for an event; less than its own limit, so that the wait says what it waited for."""
PROCESS_PATIENCE = 200.0 * FACTOR
"""The same for what takes several processes, which import and compile one after the other on a slow machine."""
TEST_LIMIT = 60.0 * FACTOR
"""Seconds that a test may take, unless it names its own limit with `@pytest.mark.timeout(SECONDS * FACTOR)`."""
PROCESS_TEST_LIMIT = 240.0 * FACTOR
"""The same for a test that is marked `process` or `thorough`."""
PRODUCT_LIMITS = {
    "BM_CONNECT_TIMEOUT": 60.0 * FACTOR,
    "BM_FIRST_DATA_TIMEOUT": 120.0 * FACTOR,
    "BM_PEER_TIMEOUT": 60.0 * FACTOR,
    "BM_BOARD_TIMEOUT": 60.0 * FACTOR,
    "BM_STOP_TIMEOUT": 60.0 * FACTOR,
    "BM_SEEN_TIMEOUT": 60.0 * FACTOR,
    "BM_READY_TIMEOUT": 60.0 * FACTOR,
    "BM_RESTART_WINDOW": 600.0 * FACTOR,
}
"""The environment in which process tests run the product, so that a slow machine is not taken for a dead peer."""
