"""Train the recurrent duelling double Q network in CarRacing, from rewards alone."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch

from dreamfleet.common.errors import StoppedError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.runs.seeds import training_seed
from dreamfleet.worker.addons.baselines.network import Learner, Networks, QPolicy
from dreamfleet.worker.addons.baselines.presets import CHECKPOINT, AgentConfig, LearningConfig, epsilon_of
from dreamfleet.worker.addons.baselines.progress import (
    EpisodeRecord,
    TrainingProgress,
    TrainingReport,
    is_goal_reached,
    make_reports,
    parse_progress,
)
from dreamfleet.worker.addons.baselines.replay_buffer import Episode, ReplayBuffer, first_in_replay
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, run_episode
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS
from dreamfleet.worker.training.checkpoint import load_checkpoint, save_checkpoint
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size
from dreamfleet.worker.training.torch_setup import on_one_thread
from dreamfleet.worker.training.training_state import disable_triton_after_mesa, resume_command

CURVE, LOCK = "drqn.jsonl", "drqn.lock"

OnEpisode = Callable[[int, TrainingReport | None], None]
"""Called after each episode with the number driven, and a report when one is due."""


def train_drqn(
    folder: Path, layers: AgentConfig, config: LearningConfig,
    on_episode: OnEpisode = lambda _episodes, _report: None, device: torch.device | None = None,
    stop: Stop = never_stop, new: bool = False,
) -> dict[str, float]:  # fmt: skip
    """Train, or resume, up to `config.episodes` or the goal; return the figures of the training.

    A checkpoint is written after each episode, and an episode depends on the seed, its number and the checkpoint before
    it alone: a resumed training repeats an interrupted episode bit for bit. `StoppedError` if `stop` asks for a stop.
    `UsageError` while another process trains in the folder: each would delete the other's episodes.
    """
    with folder_lock(folder / LOCK, "training"), on_one_thread():
        training = AgentTraining(folder, layers, config, device, new)
        on_episode(training.episodes, None)
        try:
            while not training.done:
                training.drive(stop)
                training.save()
                on_episode(training.episodes, training.report)
        finally:
            training.close()
    return training.figures


class AgentTraining:
    """The state of a training: networks, replay buffer and episodes, in memory and on disk."""

    def __init__(
        self, folder: Path, layers: AgentConfig, config: LearningConfig, device: torch.device | None, new: bool
    ) -> None:
        self._folder, self._layers, self._config, self._new = folder, layers, config, new
        torch.manual_seed(config.seed)
        self._networks = Networks(layers).to(device)
        disable_triton_after_mesa()
        self._optimiser = torch.optim.Adam(self._networks.online.parameters(), lr=config.rate)
        self._records: list[EpisodeRecord] = []
        self._oldest = 0  # first episode in the replay buffer
        self._replay = ReplayBuffer(config)
        plain = None if new else load_checkpoint(self._path, self._networks, self._optimiser)
        found = None if plain is None else parse_progress(self._path, plain)
        self._learner = Learner(self._networks, self._optimiser, config, found.update if found else 0)
        if found is not None:
            self._resume(found)
        else:
            self.save()
            shutil.rmtree(folder / "replay", ignore_errors=True)
        self._environment = find_world().make_recorded(preprocessing_of_size(layers.picture).name)

    @property
    def episodes(self) -> int:
        """How many episodes are driven so far."""
        return len(self._records)

    @property
    def done(self) -> bool:
        """Whether all episodes are driven or the goal is reached."""
        config = self._config
        return self.episodes >= config.episodes or is_goal_reached(self._records, config.report_every, config.goal)

    @property
    def report(self) -> TrainingReport | None:
        """The report due after the last episode, or `None`."""
        due = self.episodes % self._config.report_every == 0
        return make_reports(self._records, self._config.report_every)[-1] if due else None

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the whole training: episodes, updates, mean score of the last report and of the best one."""
        every = self._config.report_every
        means = [each.mean for each in make_reports(self._records, every)] or [self._records[-1].score]
        goal = is_goal_reached(self._records, every, self._config.goal)
        return {"episodes": self.episodes, "updates": self._learner.updates, "mean_score": round(means[-1], 2),
                "best_mean_score": round(max(means), 2), "goal_reached": goal}  # fmt: skip

    def drive(self, stop: Stop) -> None:
        """Drive the next episode while learning from earlier ones, then add it to the replay buffer."""
        number, config = self.episodes, self._config
        random = np.random.default_rng([config.seed, number])
        epsilon = epsilon_of(config, number)
        policy = QPolicy(self._networks.online, epsilon, random)
        policy.begin(NO_PARAMETERS)
        drive, losses = EpisodeRecorder(), []
        episode_config = EpisodeConfig(training_seed(config.seed, number, 0), config.steps, config.patience)
        before = sum(each.decisions for each in self._records)
        for moment in run_episode(self._environment, policy, episode_config):
            if stop():
                raise StoppedError(
                    f"stopped in episode {number + 1} of {config.episodes}: {self._path} keeps those before it; "
                    f"{resume_command(self._new)} drives it again and continues from there"
                )
            drive.see(moment, policy)
            due = policy.is_new_decision and (before + drive.decisions) % config.learn_every == 0
            if due and number >= config.random_episodes and (traces := self._replay.sample(random)):
                losses.append(self._learner.learn(traces))
        episode = drive.episode
        episode.save(episode_file(self._folder, number))
        self._replay.add(episode)
        loss = fmean(losses) if losses else None
        self._records.append(EpisodeRecord(drive.score, drive.steps, len(episode), epsilon, loss))

    def save(self) -> None:
        """Write the checkpoint, then the curve that follows from it; delete episodes that left the replay buffer."""
        self._oldest = max(self._oldest, self._first_to_keep)
        progress = TrainingProgress(self._learner.updates, self._oldest, tuple(self._records), asdict(self._config))
        save_checkpoint(self._path, self._networks, self._optimiser, asdict(progress))
        self._write_curve()
        for path in (self._folder / "replay").glob("[0-9]*.npz"):
            if path < episode_file(self._folder, self._oldest):
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """Release the environment."""
        self._environment.close()

    @property
    def _path(self) -> Path:
        return self._folder / CHECKPOINT

    @property
    def _first_to_keep(self) -> int:
        return first_in_replay([each.decisions for each in self._records], self._config.replay)

    def _resume(self, found: TrainingProgress) -> None:
        self._records = list(found.episodes)
        self._oldest = max(found.oldest, self._first_to_keep)
        for group in self._optimiser.param_groups:
            group["lr"] = self._config.rate
        for number in range(self._oldest, self.episodes):
            self._replay.add(Episode.load(episode_file(self._folder, number), self._layers.picture))
        self._write_curve()

    def _write_curve(self) -> None:
        path = self._folder / CURVE
        lines = [json.dumps(asdict(each)) for each in make_reports(self._records, self._config.report_every)]
        with explain_write_errors(path), atomic_write(path) as file:
            file.write("".join(f"{line}\n" for line in lines).encode())


def episode_file(folder: Path, number: int) -> Path:
    """The path of a training's episode, from which a resumed training refills its replay buffer."""
    return folder / "replay" / f"{number:06d}.npz"


class EpisodeRecorder:
    """Records an episode while it is driven, grouping environment steps into decisions."""

    def __init__(self) -> None:
        self._pictures: list[Any] = []
        self._choices: list[int] = []
        self._rewards: list[float] = []
        self._terminal = False
        self.score, self.steps = 0.0, 0

    @property
    def decisions(self) -> int:
        """The number of decisions so far."""
        return len(self._choices)

    def see(self, moment: Transition, policy: QPolicy) -> None:
        """Record one step; its reward counts for the decision in force."""
        if policy.is_new_decision:
            self._pictures.append(moment.seen)
            self._choices.append(policy.choice)
            self._rewards.append(0.0)
        self._rewards[-1] += moment.reward
        self.score += moment.reward
        self._terminal, self.steps = moment.terminal, moment.step

    @property
    def episode(self) -> Episode:
        """The recorded episode."""
        choices, rewards = np.array(self._choices, np.int64), np.array(self._rewards, np.float32)
        return Episode(np.stack(self._pictures), choices, rewards, self._terminal)
