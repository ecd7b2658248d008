"""What an iteration does, and in which order, as a function of its settings and of what is finished.
Tests config.py."""

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.plan import Phase, PhasePlan


def names(plan, number):
    return " ".join(each.name for each in plan.phases(number))


def test_an_iteration_that_goes_on_from_a_controller_lets_it_drive_and_holds_the_first_round_to_its_model():
    plan = PhasePlan(IterateConfig(init="tiny", rounds=1), collects=True)
    assert plan.next([]) == (0, "init")
    assert names(plan, 1) == "collect drive vae encode mdnrnn bundle gate evolve"
    assert plan.next([Phase.of("0/init")]) == (1, "collect")


def test_the_first_round_drives_at_random_and_later_ones_what_evolved_before_and_pass_a_gate():
    plan = PhasePlan(IterateConfig(more_drives=5), collects=True)
    assert names(plan, 1) == "collect vae encode mdnrnn bundle evolve"
    assert names(plan, 3) == "collect take drive vae encode mdnrnn bundle gate evolve"
    assert names(PhasePlan(IterateConfig()), 2) == "drive vae encode mdnrnn bundle gate evolve"


@pytest.mark.parametrize(
    ("changes", "phase"), [({"own_drives": 0}, "drive"), ({"gate_drives": 0, "gate_losses": 0}, "gate")]
)
def test_a_phase_that_would_do_nothing_is_left_out(changes, phase):
    assert phase not in names(PhasePlan(IterateConfig(**changes)), 2).split()


def test_what_comes_next_follows_from_what_is_finished():
    plan = PhasePlan(IterateConfig(rounds=2))
    finished = []
    while (phase := plan.next(finished)) is not None:
        finished.append(phase)
    assert tuple(finished) == (*plan.phases(1), *plan.phases(2))
    assert PhasePlan(IterateConfig(rounds=3)).next(finished) == (3, "drive")
    assert PhasePlan(IterateConfig(rounds=1)).next(finished) is None


def test_a_round_whose_evolution_is_finished_gets_no_gate_behind_it():
    finished = list(PhasePlan(IterateConfig(rounds=2, gate_drives=0, gate_losses=0)))
    assert PhasePlan(IterateConfig(rounds=2)).next(finished) is None


def test_a_phase_done_again_takes_all_behind_it_along_and_what_was_begun():
    plan = PhasePlan(IterateConfig(rounds=2))
    finished = [*plan.phases(1), *plan.phases(2)[:2]]
    again = plan.phases_from(Phase.of("1/bundle"), finished)
    assert list(map(str, again)) == ["1/bundle", "1/evolve", "2/drive", "2/vae", "2/encode"]
    with pytest.raises(UsageError, match=r"2/encode .*1/collect, .*2/vae$"):
        plan.phases_from(Phase.of("2/encode"), finished)


@pytest.mark.parametrize(
    "text", ["", "vae", "0", "0/vae", "1/init", "-1/init", "x/init", "2/", "2/sleep", "-1/vae", "two/vae", "²/vae"]
)
def test_what_is_no_phase_is_refused_with_those_that_there_are(text):
    with pytest.raises(UsageError, match="collect, "):
        Phase.of(text)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"rounds": 0}, "rounds.* 1"),
        ({"drives": 1}, "drives.* 2"),
        ({"noise": -0.1}, "--noise.* 10"),
        ({"spells": -0.1}, "--spells.* 1"),
        ({"gate_drives": 1}, "--gate-drives.* 2"),
        ({"gate_losses": 3}, "--gate-losses.* 4"),
        ({"preset": "dream"}, "'dream'.* run"),
        ({"run_flags": "--schedule 'a.toml"}, "--run-flags"),
    ],
)
def test_impossible_settings_are_refused(changes, named):
    with pytest.raises(UsageError, match=named):
        IterateConfig(**changes)
