"""A run's figures, computed again from its journal alone: by SQL, NumPy and pycma, and none of this program's code.

The file is the second opinion. So formulas stand here once more, and only the run itself is started by the program.

Tests coordinator/jobs/confirmation.py, coordinator/run/generations.py and coordinator/storage/result_records.py.
"""

import csv
import json
import sqlite3
from contextlib import closing

import cma
import numpy as np
import pytest

from tests.support.processes import printed

TASK, NAME = "tests.support.tasks:Toy", "plain"
CHOOSING, CONFIRMING, FIRST_VALIDATION = 10_000, 20_000, 20_000  # episodes that choose, that confirm; the first seed
CONFIRM_EPISODES, FINALISTS = 12, 4


def started(processes, bundle):
    """A run to its end; what the coordinator answered."""
    coordinator = processes.coordinator(
        "--bundle", bundle.path, "--task", TASK, "--population", 6, "--episodes", 4, "--sigma0", 0.3, "--seed", 7,
        "--evaluate-every", 1, "--evaluation-episodes", 5, "--confirm-episodes", CONFIRM_EPISODES, "--generations", 6,
        "--json", name=NAME,
    )  # fmt: skip
    worker = processes.worker("--task", TASK, "--run", NAME)
    code, out = coordinator.finish()
    worker.end()
    assert code == 0
    return json.loads(out.splitlines()[-1])


class Recomputed:
    """Everything that follows from the journal's settings, populations and accepted results."""

    def __init__(self, path):
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as journal:
            self.facts = dict(journal.execute("SELECT key, value FROM run"))
            self.generations = journal.execute(
                "SELECT number, seeds, sigma, mean, std, best, worst, steps FROM generation ORDER BY number"
            ).fetchall()
            candidates = journal.execute("SELECT generation, number, vector, fitness FROM candidate").fetchall()
            evaluated = journal.execute("SELECT generation, vector, mean, std FROM evaluation ORDER BY 1").fetchall()
            self.results = {}
            query = "SELECT kind, generation, candidate, episode, seed, fitness, steps FROM result"
            for *key, episode, seed, fitness, steps in journal.execute(query):
                self.results.setdefault(tuple(key), {})[episode] = seed, fitness, steps
        self.candidates = {tuple(place): (np.frombuffer(each, "<f4"), score) for *place, each, score in candidates}
        self.evaluated = {number: (np.frombuffer(each, "<f4"), *score) for number, each, *score in evaluated}
        self.settings = json.loads(self.facts["settings"])

    def fitness(self, generation):
        """Each candidate's mean over its episodes."""
        rows = [self.results["score", generation, number] for number in range(self.settings["population"])]
        assert all(row.keys() == set(range(self.settings["episodes"])) for row in rows)
        return np.array([np.mean([fitness for _, (_, fitness, _) in sorted(row.items())]) for row in rows])

    def look(self, generation):
        """Mean, standard error and population deviation of one evaluation."""
        rows = sorted(self.results["evaluate", generation, 0].items())
        scores = np.array([fitness for episode, (_, fitness, _) in rows if episode < CHOOSING])
        return scores.mean(), scores.std(ddof=1) / np.sqrt(len(scores)), scores.std(), len(scores)

    def drive(self, generation, first, count):
        """The scores of one mean in a round of the confirmation, on seeds that follow from the episode's number."""
        rows = [self.results["evaluate", generation, 0][episode] for episode in range(first, first + count)]
        assert [seed for seed, *_ in rows] == [FIRST_VALIDATION + first + each for each in range(count)]
        return np.array([fitness for _, fitness, _ in rows])

    def rank(self, generation):
        """Evaluated means are ordered by their score; of equals the earliest is better."""
        return -self.look(generation)[0], generation

    def confirmed(self):
        """The generation that successive halving leaves, with its mean and standard error on fresh seeds."""
        looks = {generation: self.look(generation) for generation in self.evaluated}
        left = sorted(looks, key=self.rank)[:FINALISTS]
        totals = {each: (looks[each][0] * looks[each][3], looks[each][3]) for each in left}
        first = CHOOSING
        while len(left) > 1:
            count = CONFIRM_EPISODES // len(left)
            for each in left:
                total, seen = totals[each]
                scores = self.drive(each, first, count)
                totals[each] = total + scores.sum(), seen + len(scores)
            left.sort(key=lambda each: (-totals[each][0] / totals[each][1], each))
            first, left = first + count, left[: -(-len(left) // 2)]
        scores = self.drive(left[0], CONFIRMING, CONFIRM_EPISODES)
        return left[0], scores.mean(), scores.std(ddof=1) / np.sqrt(len(scores))


def check_search(found):
    """Population, step size, fitness, ranks and statistics of each generation, and the mean that was evaluated."""
    random = np.random.Generator(np.random.PCG64(found.settings["seed"]))
    options = {  # pycma with the run's random numbers
        "popsize": found.settings["population"], "CMA_diagonal": True, "seed": np.nan, "verbose": -9,
        "randn": lambda *shape: random.standard_normal(shape),
    }  # fmt: skip
    size = len(found.candidates[0, 0][0])
    strategy = cma.CMAEvolutionStrategy(np.zeros(size), found.settings["sigma0"], options)
    for number, seeds, sigma, mean, std, best, worst, steps in found.generations:
        assert sigma == pytest.approx(np.median(strategy.stds), rel=1e-12)
        asked = strategy.ask()
        for index, each in enumerate(asked):
            np.testing.assert_array_equal(found.candidates[number, index][0], np.asarray(each).astype("<f4"))
        assert (number, len(asked)) not in found.candidates
        assert len(json.loads(seeds)) == found.settings["episodes"]
        if mean is None:
            continue  # the generation that was open at the end
        fitness = found.fitness(number)
        stored = np.array([found.candidates[number, index][1] for index in range(len(asked))], dtype=np.float64)
        np.testing.assert_allclose(stored, fitness, rtol=1e-14)
        np.testing.assert_array_equal(np.argsort(-stored, kind="stable"), np.argsort(-fitness, kind="stable"))
        expected = fitness.mean(), fitness.std(), fitness.max(), fitness.min()
        assert (mean, std, best, worst) == pytest.approx(expected, rel=1e-12)
        rows = [found.results["score", number, index] for index in range(len(asked))]
        assert steps == sum(each[2] for row in rows for each in row.values())
        assert {row[0][0] for row in rows} == {json.loads(seeds)[0]}, "all candidates drive the same seeds"
        strategy.tell(asked, (-stored).tolist())
        np.testing.assert_array_equal(found.evaluated[number][0], strategy.mean.astype("<f4"))


def check_scores(processes, found, answer):
    """Each place that shows an evaluation or the confirmed score has the same mean and error."""
    looks = {generation: found.look(generation) for generation in found.evaluated}
    for generation, (mean, _, deviation, _) in looks.items():
        assert found.evaluated[generation][1:] == pytest.approx((mean, deviation))
    shown, folder = json.loads(printed("runs", "show", NAME, "--json")), processes.folder / NAME
    printed("runs", "export", NAME, "--csv", "--out", folder)
    exported = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in folder.glob("*.csv")}
    for rows in (shown["evaluations"], exported["evaluations"]):
        assert [int(each["generation"]) for each in rows] == list(looks)
        for each in rows:
            assert [float(each["mean"]), float(each["error"])] == pytest.approx(looks[int(each["generation"])][:2])
    best = min(looks, key=found.rank)
    assert answer["best"]["generation"] == best
    assert [answer["best"]["mean"], answer["best"]["error"]] == pytest.approx(looks[best][:2])
    generation, mean, error = found.confirmed()
    with np.load(processes.runs / NAME / "controller.npz") as file:
        report = json.loads(str(file["about"]))["provenance"]
        np.testing.assert_array_equal(file["parameters"], found.evaluated[generation][0])
    assert (report["generation"], report["confirmed"]) == (generation, True)
    assert [report["validation_mean"], report["validation_error"]] == pytest.approx([mean, error])
    for each in (answer["confirmed"], shown["confirmed"], *exported["confirmation"]):
        assert int(each["generation"]) == generation
        assert [float(each["mean"]), float(each["error"])] == pytest.approx([mean, error])
    assert f"{mean:.1f} ± {error:.1f}" in printed("runs", "show", NAME)


def check_status(processes, found):
    """A coordinator that goes on and waits for workers tells the same of what was."""
    coordinator = processes.resume(NAME, "--generations", 99)
    coordinator.wait_until_serving()
    code, out, err = processes.call("status", "--connect", processes.endpoint, "--json")
    coordinator.end()
    assert code == 0, err
    status = json.loads(out)
    last, best = max(found.evaluated), min(found.evaluated, key=found.rank)
    for each, generation in ((status["evaluation"], last), (status["best"], best)):
        assert each["generation"] == generation
        mean, error, deviation, episodes = found.look(generation)
        assert [each["mean"], each["error"], each["std"], each["episodes"]] == pytest.approx(
            [mean, error, deviation, episodes]
        )
    confirmed = status["confirmed"]
    assert (confirmed["generation"], confirmed["mean"], confirmed["error"]) == pytest.approx(found.confirmed())
    fitness = found.fitness(last)
    shown = [status["last"][each] for each in ("mean", "std", "best", "worst")]
    assert shown == pytest.approx([fitness.mean(), fitness.std(), fitness.max(), fitness.min()])


@pytest.mark.exact
@pytest.mark.slow
def test_a_run_is_what_its_journal_comes_to(processes, random_bundle):
    answer = started(processes, random_bundle)
    found = Recomputed(processes.runs / NAME / "journal.sqlite")
    assert len(found.generations) == 7
    check_search(found)
    check_scores(processes, found, answer)
    check_status(processes, found)
