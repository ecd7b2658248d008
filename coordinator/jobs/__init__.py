"""What a run scores: generations, evaluations, confirmations and kept rollouts, as jobs. Pure.

Its pages: docs/reference/protocol.md, docs/how-to/stages.md, docs/how-to/rounds.md.
"""

__all__ = [
    "scoring_job",
    "generation",
    "evaluation",
    "confirmation",
    "checks",
    "rollout_collection",
    "upload_assembler",
    "history",
]
