"""Robots of the same name: each starts disarmed and says so, and no token of a stranger does more."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import ERROR, OK
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, script, session
from tests.waiting import wait_until


@pytest.mark.hazard("H48")
def test_starts_disarmed_beside_a_robot_of_the_same_name() -> None:
    router = free_endpoint()
    with script(ROUTER, router), contextlib.ExitStack() as stack:
        first = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(), connect=(router,)))))
        warnings, commands = list[str](), list[str]()
        second = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(), connect=(router,)), warnings.append)))
        assert len(warnings) == 1 and "change bus.robot" in warnings[0] and "\n" not in warnings[0]
        second.subscribe_commands(lambda request: commands.append(request.topic), {})
        assert second.status().level == ERROR and not second.is_unique and commands == ["cmd/stop"]
        with contextlib.closing(Bus(BusConfig(robot="other", listen=(), connect=(router,)))) as other:
            assert other.status().level == first.status().level == OK
        first.close()
        wait_until(lambda: second.status().level == OK and second.is_unique)


@pytest.mark.parametrize("token", ["omnid/alive", "omnid/alive/x"])
def test_a_token_of_a_stranger_keeps_no_robot_from_starting(token: str) -> None:
    """It may keep the robot disarmed, and the status says so, where no user needs a password."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with session(mode="client", connect__endpoints=[endpoint]) as stranger:
            held = stranger.liveliness().declare_token(token)
            if token.endswith("x"):
                wait_until(lambda: bus.status().level == ERROR)
                wait_until(lambda: commands == ["cmd/stop"])
            else:
                stranger.put("omnid/cmd/mark", b"")
                wait_until(lambda: commands == ["cmd/mark"])
                assert bus.is_unique
            del held
        wait_until(lambda: bus.status().level == OK)


@pytest.mark.hazard("H48")
def test_with_users_only_the_robot_declares_tokens_below_its_name(tmp_path: Path) -> None:
    endpoint, users = free_endpoint(), tmp_path / "users"
    users.write_text("eve:secret\n")
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), users_file=str(users)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with session(
            mode="client",
            connect__endpoints=[endpoint],
            transport__auth__usrpwd__user="eve",
            transport__auth__usrpwd__password="secret",
        ) as stranger:
            held = stranger.liveliness().declare_token("omnid/alive/x")
            stranger.put("omnid/cmd/mark", b"")
            wait_until(lambda: commands == ["cmd/mark"])
            assert bus.is_unique and bus.status().level == OK
            replies = list(stranger.liveliness().get("omnid/alive"))
            assert len(replies) == 1, "that of the robot is still seen"
            del held


@pytest.mark.hazard("H48")
def test_warns_once_of_a_robot_of_the_same_name_that_appears_later() -> None:
    """Two robots start as clients without a router, which connects them later."""
    router, warnings = free_endpoint(), list[str]()
    with contextlib.ExitStack() as stack:
        first, second = (
            stack.enter_context(contextlib.closing(Bus(BusConfig(mode="client", connect=(router,)), warnings.append)))
            for _ in range(2)
        )
        connection = stack.enter_context(script(ROUTER, router))
        wait_until(
            lambda: (
                bool([bus.connect() for bus in (first, second)])
                and first.status().level == second.status().level == ERROR
            )
        )
        assert "bus.robot" in first.status().message and first.status().values["same_name"] == "1"
        assert len(warnings) == 2
        connection.kill()
        wait_until(lambda: first.status().level == second.status().level == OK)
        assert len(warnings) == 2, "each warns once"
