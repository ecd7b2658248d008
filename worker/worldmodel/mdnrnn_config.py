"""The configuration of an MDN-RNN, without torch. Pages: presets.md, sources.md, dreams-notes.md, takecover.md."""

from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.validation import added_option
from dreamfleet.worker.worldmodel.config_fields import check_factors, check_sizes, loss_factor

Reward = Literal["none", "positive", "notebook", "value"]
Probability = TypeVar("Probability", float, NDArray[np.float32], NDArray[np.float64])
MOST_REWARD = 1000


@dataclass(frozen=True)
class MDNRNNConfig:
    """Inputs, an LSTM of `hidden` units, `mixtures` Gaussians per latent dimension, and heads.

    A `joint` mixture has one weight per Gaussian, so that a draw takes all latents from the same one; with
    `columns` one per Gaussian and column.

    The reward head predicts the logit of a positive reward, the logit of the `notebook`'s label (the reward is not
    positive and the episode goes on), or the reward's value. The done head predicts the logit of the episode's end.
    With `lost` a step also counts as an end if no reward follows for so many steps: dreams then end where the road is
    lost.

    Ends are rare, so a step that ends may count `done_weight` times in the done head's loss. Such a head predicts ends
    too often; `calibrate_end` undoes that.
    """

    latent: int = option(32, "latents of a picture, as many as the VAE's")
    actions: int = 3
    hidden: int = option(256, "units of the LSTM")
    mixtures: int = option(5, "Gaussians per latent dimension")
    reward: Reward = option(  # noqa: RUF009 - a name for literals
        "positive", "what the reward head predicts: nothing, a positive reward, the notebook's label, or the value"
    )
    done: bool = option(default=False, text="a head that predicts the episode's end")
    previous_reward: bool = option(default=False, text="take the reward head's output of the step before as an input")
    dropout: float = option(0.0, "dropout of the LSTM's outputs before the heads, in training and in dreams")
    window: int = option(0, "last inputs that attention sees, the current one included; 0: no attention")
    attention_units: int = option(64, "units of the attention score")
    lost: int = added_option(0, "steps without reward that the done head predicts as an end; 0: none")
    z_factor: float = loss_factor("weight of the likelihood of the next latents")
    reward_factor: float = loss_factor("weight of the reward head's loss")
    first_reward: float = added_option(0.0, "previous reward's label at the first step of a drive")
    done_factor: float = loss_factor("weight of the done head's loss")
    done_weight: float = added_option(1.0, "weight of a step that ends against one that does not, as ends are rare")
    reward_scale: float = added_option(
        1.0, "what a reward is divided by before its value is learnt; 0: the rewards' standard deviation in the data"
    )

    joint: bool = added_option(default=False, text="a mixture of all latents together, or of each column's")
    columns: int = added_option(
        0, "latents of each column, as the VAE's: units of the LSTM, and convolutions behind it, then lie in columns"
    )

    def __post_init__(self) -> None:
        check_sizes(self)
        if min(self.latent, self.actions, self.hidden, self.mixtures, self.attention_units) < 1 or self.window < 0:
            raise UsageError("an MDN-RNN's sizes must be at least 1, its window at least 0")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"dropout must be from 0 to below 1, not {self.dropout}")
        if self.previous_reward and self.reward == "none":
            raise UsageError("the previous reward as an input needs a reward head: in a dream nothing else predicts it")
        if self.lost < 0 or (self.lost and not self.done):
            raise UsageError("lost is a number of steps that a done head predicts: give done=true, and 0 or more")
        if self.columns < 0 or (self.columns and (self.dropout or self.window)):
            raise UsageError("columns are from 0, and go without dropout and a window")
        if self.columns and (self.latent % self.columns or not self.column_units):
            raise UsageError(
                f"columns is as many latents as the VAE has for each column, and the LSTM has a unit for each or more; "
                f"not {self.columns} of {self.latent} with {plural(self.hidden, 'unit')}"
            )
        check_factors(self, "z_factor", "reward_factor", "done_factor", "done_weight")
        if self.reward_factor != 1 and self.reward == "none":
            raise UsageError("reward_factor is the weight of a reward head's loss: give another reward than none")
        if (self.done_factor, self.done_weight) != (1, 1) and not self.done:
            raise UsageError("done_factor and done_weight weight a done head's loss: give done=true")
        if self.reward_scale not in (0, 1):
            check_factors(self, "reward_scale")
            if self.reward != "value":
                raise UsageError("reward_scale divides the rewards whose value is predicted: give reward=value")
        if self.first_reward and not self.previous_reward:
            raise UsageError("first_reward is the label of previous_reward at the first step: give that too")
        if not abs(self.first_reward) <= MOST_REWARD:
            raise UsageError(f"first_reward must be from -{MOST_REWARD} to {MOST_REWARD}, not {self.first_reward}")

    @property
    def inputs(self) -> int:
        """The size of an input: latents, actions and the previous reward."""
        return self.latent + self.actions + self.previous_reward

    @property
    def lstm_inputs(self) -> int:
        """The size of the LSTM's input: `inputs`, and the attention's weighted sum."""
        return self.inputs + (self.latent + self.actions if self.window else 0)

    @property
    def side(self) -> int:
        """The number of columns."""
        return self.latent // self.columns

    @property
    def column_units(self) -> int:
        """The units of the LSTM that lie in each column: three of four units, the others see all columns."""
        return self.hidden * 3 // 4 // self.side

    @property
    def units_in_columns(self) -> int:
        """The units of the LSTM that lie in a column, which are its first."""
        return self.column_units * self.side

    @property
    def has_reward_head(self) -> bool:
        """Whether there is a reward head."""
        return self.reward != "none"

    @property
    def factors(self) -> dict[str, float]:
        """The weights of the parts of the loss, by name."""
        return {"latent": self.z_factor, "reward": self.reward_factor, "done": self.done_factor}

    @property
    def outputs(self) -> int:
        """The number of head outputs: log weights, means, log deviations `(latent, mixtures)` each, reward, done."""
        return self.mixtures * sum(self.rows) + self.has_reward_head + self.done

    @property
    def weighted(self) -> int:
        """The number of mixtures with weights of their own: one of all latents, one a column, or one a latent."""
        return self.latent // (self.columns or self.latent if self.joint else 1)

    @property
    def rows(self) -> tuple[int, int, int]:
        """How many weights, means and deviations each mixture has."""
        return self.weighted, self.latent, self.latent

    @property
    def state(self) -> int:
        """The size of a state: hidden, cell, previous reward, window of latents and actions (oldest first)."""
        return 2 * self.hidden + self.previous_reward + self.window * (self.latent + self.actions)


def calibrate_end(predicted: Probability, weight: float) -> Probability:
    """The probabilities of an end of which a done head trained with `done_weight` `weight` predicted `predicted`.

    With that weight the head learns odds that are `weight` times too high. At weight 1 the result is `predicted`.

    >>> calibrate_end(0.75, weight=3.0)
    0.5
    """
    if weight == 1:
        return predicted
    others: Any = weight * (1 - predicted)
    calibrated: Probability = predicted / (predicted + others)
    return calibrated


# Fields that a resumed training may add to a trained model: a done head behind the others, and what it predicts.
ADDABLE_HEADS = frozenset({"done", "lost"})
REWARDED = MDNRNNConfig()
PAPER = MDNRNNConfig(reward="none")
ARTICLE = MDNRNNConfig(previous_reward=True)
# The notebook's drives have a reward of -0.1 before their first action, whose label is 1.
NOTEBOOK = MDNRNNConfig(reward="notebook", previous_reward=True, first_reward=1.0)
ATTENTIVE = MDNRNNConfig(window=8, hidden=236)  # 421,277 parameters, REWARDED has 422,625
