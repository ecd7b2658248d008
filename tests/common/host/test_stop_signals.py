import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from dreamfleet.common.host.stop_signals import SIGNALS, signals_deferred, stop_on_signals


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_stops_and_the_second_interrupts(number):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), stop_on_signals() as stop:  # noqa: PT012
        assert not stop()
        os.kill(os.getpid(), number)
        assert stop()
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", SIGNALS)
def test_deferred_signals_arrive_after_the_operation(number):
    finished = []
    with pytest.raises(KeyboardInterrupt), stop_on_signals() as stop:  # noqa: PT012
        with signals_deferred():
            signal.raise_signal(number)
            finished.append(stop())
        assert stop()
        with signals_deferred():
            signal.raise_signal(number)
            finished.append(True)
    assert finished == [False, True]
    with ThreadPoolExecutor(1) as pool:  # another thread defers none
        assert pool.submit(lambda: signals_deferred().__enter__()).result() is None
