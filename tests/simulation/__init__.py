"""A seeded simulation of a whole fleet in one process, under faults, by a clock of its own.

What decides is the product's own code: `Run`, `WorkerProtocol`, `Fleet`, `Generation`, `Evaluations`,
`UploadAssembler` and `Journal` on one side, `Membership`, `Backlog`, `Outbox` and `UploadQueue` on the other.
What is simulated is everything that it meets: the
network, the disk, the slots, the clock, and people. A schedule is a number: it gives the same play on every machine,
and when it breaks a rule it is cut down to the few faults that it takes.

    python -m tests.simulation --schedules 100000 --seed 1 --jobs 2
"""
