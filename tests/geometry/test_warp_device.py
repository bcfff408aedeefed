"""Work that threads share."""

import time
from concurrent.futures import ThreadPoolExecutor

from mjx_grasp.geometry.warp_device import once


def test_what_many_threads_want_is_made_once_and_kept():
    made = []

    def build():
        time.sleep(0.05)  # long enough that all of them want it meanwhile
        made.append(object())
        return made[-1]

    result = once(build)
    assert made == []
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: result(), range(8)))
    assert len(made) == 1 and all(x is made[0] for x in [*found, result()])
