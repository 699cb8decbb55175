"""Notices for the log: order, what was overwritten, what is none."""

from pathlib import Path

import pytest

from jtqd.daemon.shared.notices import WARNING as NOTICE_WARNING
from jtqd.daemon.shared.notices import Notices, NoticesError, NoticesReader


def test_notices_reach_a_reader_in_order_and_the_overwritten_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "notices"
    notices = Notices(path, capacity=8)
    reader = NoticesReader(path)
    assert reader.read() == ([], 0)
    notices.add(NOTICE_WARNING, "emcy", 3, "node 3: EMCY 8130h")
    (notice,), lost = reader.read()
    assert (notice.number, notice.level, notice.node, notice.topic, notice.text) == (
        1,
        NOTICE_WARNING,
        3,
        "emcy",
        "node 3: EMCY 8130h",
    )
    assert (lost, reader.read()) == (0, ([], 0))
    for n in range(20):
        notices.add(NOTICE_WARNING, "t" * 40, 0, f"{n} " + "é" * 300)
    news, lost = reader.read()
    assert [each.number for each in news] == list(range(14, 22))
    assert lost == 12
    assert news[-1].text.startswith("19 é")
    assert len(news[-1].text.encode()) <= 212
    assert len(news[-1].topic) == 20
    assert path.stat().st_mode & 0o007 == 0, "not for everybody"


def test_notices_that_are_none(tmp_path: Path) -> None:
    for content in (None, b"", b"x" * 10, bytes(32), bytes(1000)):
        path = tmp_path / "n"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(NoticesError):
            NoticesReader(path)
