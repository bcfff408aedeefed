import signal
import subprocess
import sys

import pytest

from mjx_grasp.learning.interrupt import InterruptGuard


@pytest.fixture(autouse=True)
def default_handler():
    """Tests that are started in the background ignore interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_one_interrupt_is_a_request_and_no_exception(capfd):
    with InterruptGuard() as guard:
        assert not guard.requested
        signal.raise_signal(signal.SIGINT)
        assert guard.requested
    assert "Ctrl-C again stops at once" in capfd.readouterr().err
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_an_ignored_interrupt_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with InterruptGuard() as guard:
        signal.raise_signal(signal.SIGINT)
        assert not guard.requested
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


BUSY = """
import hashlib, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from mjx_grasp.learning.interrupt import InterruptGuard
with InterruptGuard():
    print("busy", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # no Python handler runs within
"""


def test_the_second_interrupt_ends_even_a_computation():
    run = subprocess.Popen(
        [sys.executable, "-c", BUSY], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert run.stdout.readline() == "busy\n"
        run.send_signal(signal.SIGINT)
        assert "stopping after this iteration" in run.stderr.readline()
        run.send_signal(signal.SIGINT)
        assert run.wait(timeout=20) == 130
        assert run.stderr.read().strip() == "interrupted"
    finally:
        run.kill()
        run.communicate()
