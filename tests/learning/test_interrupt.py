import signal

import pytest

from mjx_grasp.learning.interrupt import InterruptGuard


@pytest.fixture(autouse=True)
def default_handler():
    """Tests that are started in the background ignore interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_first_interrupt_is_a_request_and_the_second_an_exception(capsys):
    with InterruptGuard() as guard:
        assert not guard.requested
        signal.raise_signal(signal.SIGINT)
        assert guard.requested
        assert "Ctrl-C again stops" in capsys.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_interrupt_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with InterruptGuard() as guard:
        signal.raise_signal(signal.SIGINT)
        assert not guard.requested
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
