"""What a run scores: generations, evaluations, confirmations and kept rollouts, as jobs; checks of them. Pure.

Pages: protocol.md, stages.md, rounds.md.
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
