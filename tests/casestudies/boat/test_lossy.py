"""A topic that the server refuses is reported."""

import pytest

from casestudies import publishing

TYPE = "boat_msgs/Raw"


class Server:
    def __init__(self, known):
        self._known = known

    async def topic_type(self, _topic):
        return self._known


@pytest.mark.parametrize(
    ("known", "warnings"), [(None, 0), ("", 1), ("boat_msgs/msg/Raw", 0), ("std_msgs/String", 1)]
)
async def test_a_refused_topic_is_reported_as_far_as_rosapi_tells(known, warnings, capsys, monkeypatch):
    monkeypatch.setattr(publishing, "SETTLED_S", 0)
    await publishing.report_refused(Server(known), "/boat/raw", TYPE)
    assert capsys.readouterr().err.count("warning: ") == warnings
