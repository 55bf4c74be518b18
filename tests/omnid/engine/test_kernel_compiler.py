"""One program compiles while others wait; where it or its helpers fail, a program compiles itself."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from omnid.engine import kernel_store
from tests.omnid.engine.kernel_programs import (
    COMPILED_HERE,
    READ,
    compilations,
    folder_in,
    held_lock,
    run,
    started,
)


def test_two_programs_compile_once(tmp_path: Path) -> None:
    with started(tmp_path) as one, started(tmp_path) as other:
        outputs = [program.communicate(timeout=300)[0] for program in (one, other)]
    assert compilations("".join(outputs)) == 1
    assert all(output.endswith(f"{READ}\n") for output in outputs)


def test_a_program_waits_for_the_one_that_compiles_and_goes_on_when_it_ends(tmp_path: Path) -> None:
    with ExitStack() as stack:
        with held_lock(tmp_path):
            program = stack.enter_context(started(tmp_path))
            assert program.stdout is not None and "another program compiles" in program.stdout.readline()
            assert program.poll() is None and not [*tmp_path.glob("kernels-*")]
        # The system has taken the lock from its holder, as it does where a program is killed.
        output, _ = program.communicate(timeout=300)
    assert compilations(output) == 1 and output.endswith(f"{READ}\n")


def test_a_program_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    """Nor are helpers that take too long: the program compiles itself."""
    with held_lock(tmp_path):
        done = run(tmp_path, "impatient")
    assert "WARNING it has compiled nothing for" in done.stdout, done.stderr
    assert done.stdout.endswith(f"{COMPILED_HERE}\n") and kernel_store.is_intact(folder_in(tmp_path))


def test_where_helpers_fail_the_program_compiles_itself(tmp_path: Path) -> None:
    done = run(tmp_path, "no-helpers")
    assert done.stdout.endswith(f"{COMPILED_HERE}\n"), done.stderr
    assert kernel_store.is_intact(folder_in(tmp_path))
