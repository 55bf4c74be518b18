"""The channel between the daemon and the controller process."""

from __future__ import annotations

from contextlib import closing

import pytest

from omnid.controller.ipc import NO_MESSAGE, Channel, socket_pair


def test_counts_each_message_that_the_other_end_cannot_take() -> None:
    here, there = (Channel(end) for end in socket_pair())
    with closing(here), closing(there):
        sent = 0
        while not here.lost:
            here.send(sent)
            sent += 1
        here.send("lost, too")
        assert here.lost == 2
        assert [there.receive(0.0) for _ in range(sent - 1)] == list(range(sent - 1))
        assert there.receive(0.0) is NO_MESSAGE


def test_the_end_comes_after_what_was_sent() -> None:
    here, there = (Channel(end) for end in socket_pair())
    with closing(here), closing(there):
        here.send("last")
        here.finish_sending()
        there.send("still heard")
        assert there.receive(1.0) == "last" and here.receive(1.0) == "still heard"
        with pytest.raises(EOFError):
            there.receive(1.0)
