"""What an MDN-RNN is made of; apart from the module, so that what only configures needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.worldmodel.loss_factors import added_option, check_factors, loss_factor

Reward = Literal["none", "positive", "notebook", "value"]
MOST_REWARD = 1000


@dataclass(frozen=True)
class MDNRNNConfig:
    """Inputs, an LSTM of `hidden` units, `mixtures` Gaussians a latent dimension, heads.

    The reward head: the logit of a positive reward; the `notebook`'s, of a reward that is not positive while the
    episode goes on; or the reward's value. The done head: the logit of a step that ends the episode, or, with `lost`,
    behind which no reward follows for so many steps either: a dream of such a model ends where the road is lost.
    """

    latent: int = option(32, "latents of a picture, as the VAE has them")
    actions: int = 3
    hidden: int = option(256, "units of the LSTM")
    mixtures: int = option(5, "Gaussians a latent dimension")
    reward: Reward = option(  # noqa: RUF009 - a name for literals
        "positive", "what the reward head tells: none, that a reward is positive, the notebook's label, or the value"
    )
    done: bool = option(default=False, text="a head that tells of the episode's end")
    previous_reward: bool = option(default=False, text="what the reward head told of the step before is an input")
    dropout: float = option(0.0, "share of the LSTM's outputs that the heads do not see while it learns and dreams")
    window: int = option(0, "inputs that attention looks at, the current one among them; 0: none")
    attention_units: int = option(64, "units of the attention's score")
    lost: int = added_option(0, "steps without reward that the done head foretells as an end; 0: none")
    z_factor: float = loss_factor("weighs the likelihood of the next latents")
    reward_factor: float = loss_factor("weighs the reward head's loss")
    first_reward: float = added_option(0.0, "what a drive's first step has as the previous reward's label")

    def __post_init__(self) -> None:
        if min(self.latent, self.actions, self.hidden, self.mixtures, self.attention_units) < 1 or self.window < 0:
            raise UsageError("an MDN-RNN's sizes must be at least 1, its window at least 0")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"--dropout must be from 0 to below 1, not {self.dropout}")
        if self.previous_reward and self.reward == "none":
            raise UsageError("the previous reward as an input needs a reward head: in the dream nothing else tells it")
        if self.lost < 0 or (self.lost and not self.done):
            raise UsageError("--lost is a number of steps that a done head foretells: give --done, and 0 or more")
        check_factors(self, "z_factor", "reward_factor")
        if self.reward_factor != 1 and self.reward == "none":
            raise UsageError("--reward-factor weighs the loss of a reward head: give --reward another kind than none")
        if self.first_reward and not self.previous_reward:
            raise UsageError("--first-reward is what the first step has as its --previous-reward: give that too")
        if not abs(self.first_reward) <= MOST_REWARD:
            raise UsageError(f"--first-reward must be from -{MOST_REWARD} to {MOST_REWARD}, not {self.first_reward}")

    @property
    def inputs(self) -> int:
        """Latents, actions and the previous reward."""
        return self.latent + self.actions + self.previous_reward

    @property
    def lstm_inputs(self) -> int:
        """`inputs`, and beside them what attention makes of the window."""
        return self.inputs + (self.latent + self.actions if self.window else 0)

    @property
    def has_reward_head(self) -> bool:
        """Whether there is a reward head."""
        return self.reward != "none"

    @property
    def factors(self) -> dict[str, float]:
        """Weights of the parts of the loss, by name."""
        return {"latent": self.z_factor, "reward": self.reward_factor, "done": 1.0}

    @property
    def outputs(self) -> int:
        """Of the heads: log weights, means, log deviations `(3, latent, mixtures)`, reward, done."""
        return 3 * self.mixtures * self.latent + self.has_reward_head + self.done

    @property
    def state(self) -> int:
        """Of a step: hidden, cell, previous reward, window of latents and actions (oldest first)."""
        return 2 * self.hidden + self.previous_reward + self.window * (self.latent + self.actions)


# What a trained model may be given behind its other heads as it learns on, and what that foretells.
ADDABLE_HEADS = frozenset({"done", "lost"})
REWARDED = MDNRNNConfig()
PAPER = MDNRNNConfig(reward="none")
ARTICLE = MDNRNNConfig(previous_reward=True)
# Before its first action the notebook's drives have a reward of -0.1, of which its label is 1.
NOTEBOOK = MDNRNNConfig(reward="notebook", previous_reward=True, first_reward=1.0)
ATTENTIVE = MDNRNNConfig(window=8, hidden=236)  # 421,277 parameters, REWARDED has 422,625
