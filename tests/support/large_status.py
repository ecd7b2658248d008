"""A status as large as a coordinator writes one."""

import dataclasses

from dreamfleet.common.client.status import Population, WorkerCount
from tests.support.samples import STATUS

FLEET = tuple(
    dataclasses.replace(
        STATUS.worker_list[0], worker=f"a-host-of-thirty-letters-x{number:04d}/0a1b2c3d", job_seconds=1.2,
        round_trip=0.05, resent=3,
    )
    for number in range(40)
)  # fmt: skip

RECENT = tuple(dataclasses.replace(STATUS.recent[0], number=number, mean=float(number)) for number in range(60))

LARGE = dataclasses.replace(
    STATUS, worker_list=FLEET, workers=WorkerCount(40, 40, 0), recent=RECENT,
    population=Population(7, 0, 64, (16,) * 30 + (4,) * 10 + (0,) * 24, (16,) * 64, (5.0,) * 40 + (None,) * 24),
)  # fmt: skip
