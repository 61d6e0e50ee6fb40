"""Ctrl-C is obeyed even where Python drops the exception."""

from __future__ import annotations

import signal
import sys

import pytest
from processes import python

from gpebo_cli.cli import interrupts


class Finaliser:
    """Whatever is raised in ``__del__`` is printed and dropped by Python."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def test_what_a_finaliser_drops_is_raised_at_the_next_stage(capsys):
    reached = []

    def run():
        with interrupts.Remembered():
            Finaliser()
            reached.append("after the signal")  # Python went on
            interrupts.check()
            reached.append("the next stage")

    with pytest.raises(KeyboardInterrupt):
        run()
    assert reached == ["after the signal"]
    assert capsys.readouterr().err == ""
    interrupts.check()  # what has been raised is over


def test_what_is_dropped_in_the_last_stage_is_raised_at_the_end():
    with pytest.raises(KeyboardInterrupt), interrupts.Remembered():
        Finaliser()
    interrupts.check()


def test_what_fails_after_a_signal_was_dropped_is_an_interruption():
    def run():
        with interrupts.Remembered():
            Finaliser()
            raise ImportError("numpy was broken off")

    with pytest.raises(KeyboardInterrupt):
        run()


def test_without_a_signal_nothing_happens_and_all_is_as_before():
    handler, hook = signal.getsignal(signal.SIGINT), sys.unraisablehook
    with interrupts.Remembered():
        interrupts.check()
        assert signal.getsignal(signal.SIGINT) is not handler
    assert signal.getsignal(signal.SIGINT) is handler
    assert sys.unraisablehook is hook


def test_a_signal_before_anything_is_loaded_is_answered():
    words = "from gpebo_cli.cli import start; import signal; signal.raise_signal(signal.SIGINT)"
    done = python("-c", words)
    assert (done.returncode, done.stderr) == (130, "gpebo: error: interrupted\n")
