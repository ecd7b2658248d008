"""A run's figures, computed again from its journal alone: by SQL, NumPy and pycma, and none of this program's code.

The file is the second opinion. So formulas stand here once more, and only the run itself is started by the program.
"""

import csv
import json
import sqlite3
from contextlib import closing

import cma
import numpy as np
import pytest

from tests.support.processes import printed

TASK, BRITTLE = "tests.support.tasks:Toy", "tests.support.tasks:Brittle"
CHOOSING, CONFIRMING, FIRST_VALIDATION = 10_000, 20_000, 20_000  # episodes that choose, that confirm; the first seed
CONFIRM_EPISODES, FINALISTS = 12, 4


def started(processes, name, bundle, *flags, task=TASK):
    """A run to its end; what the coordinator answered."""
    coordinator = processes.coordinator(
        "--bundle", bundle.path, "--task", task, "--population", 6, "--episodes", 4, "--sigma0", 0.3, "--seed", 7,
        "--evaluate-every", 1, "--evaluation-episodes", 5, "--confirm-episodes", CONFIRM_EPISODES, "--generations", 6,
        "--json", *flags, name=name,
    )  # fmt: skip
    worker = processes.worker("--task", task, "--run", name)
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
            self.events = [text for (text,) in journal.execute("SELECT text FROM event")]
            drawn = {number: set(json.loads(seeds)) for number, seeds, *_ in self.generations}  # the last ones
            place = "kind, generation, candidate, episode, seed"
            self.results, self.failed = {}, {}
            for *key, episode, seed, fitness, steps in journal.execute(f"SELECT {place}, fitness, steps FROM result"):
                if key[0] != "score" or seed in drawn[key[1]]:
                    self.results.setdefault(tuple(key), {})[episode] = seed, fitness, steps
            for *key, episode, seed in journal.execute(f"SELECT {place} FROM failure"):
                if key[0] != "score" or seed in drawn[key[1]]:
                    self.failed.setdefault(tuple(key), set()).add(episode)
        self.candidates = {tuple(place): (np.frombuffer(each, "<f4"), score) for *place, each, score in candidates}
        self.evaluated = {number: (np.frombuffer(each, "<f4"), *score) for number, each, *score in evaluated}
        self.settings = json.loads(self.facts["settings"])

    def fitness(self, generation):
        """Each candidate's mean over its episodes; NaN for one that failed."""
        found = []
        for number in range(self.settings["population"]):
            place = ("score", generation, number)
            if place in self.failed:
                found.append(np.nan)
                continue
            assert self.results[place].keys() == set(range(self.settings["episodes"]))
            found.append(np.mean([fitness for _, (_, fitness, _) in sorted(self.results[place].items())]))
        return np.array(found)

    def look(self, generation):
        """Mean, standard error and population deviation of one evaluation."""
        rows = sorted(self.results["evaluate", generation, 0].items())
        scores = np.array([fitness for episode, (_, fitness, _) in rows if episode < CHOOSING])
        return scores.mean(), scores.std(ddof=1) / np.sqrt(len(scores)), scores.std(), len(scores)

    def drive(self, generation, first, count):
        """The scores of one mean in a round of the confirmation, on seeds that follow from the episode's number."""
        rows, failed = self.results["evaluate", generation, 0], self.failures(generation)
        scored = [episode for episode in range(first, first + count) if episode not in failed]
        assert [rows[episode][0] for episode in scored] == [FIRST_VALIDATION + episode for episode in scored]
        return np.array([rows[episode][1] for episode in scored])

    def failures(self, generation):
        """The episodes of a mean's evaluation and confirmation that failed."""
        return self.failed.get(("evaluate", generation, 0), set())

    def rank(self, generation):
        """Evaluated means are ordered by failed episodes, then by their score; of equals the earliest is better."""
        failed = sum(episode < CHOOSING for episode in self.failures(generation))
        return failed, -self.look(generation)[0], generation

    def confirmed(self):
        """The generation that successive halving leaves, with its mean and standard error on fresh seeds."""
        looks = {generation: self.look(generation) for generation in self.evaluated}
        left = sorted(looks, key=self.rank)[:FINALISTS]
        failed = {each: self.rank(each)[0] for each in left}
        totals = {each: (looks[each][0] * looks[each][3], looks[each][3]) for each in left}
        first = CHOOSING
        while len(left) > 1:
            count = CONFIRM_EPISODES // len(left)
            for each in left:
                total, seen = totals[each]
                scores = self.drive(each, first, count)
                totals[each] = total + scores.sum(), seen + len(scores)
                failed[each] += count - len(scores)
            left.sort(key=lambda each: (failed[each], -totals[each][0] / totals[each][1], each))
            first, left = first + count, left[: -(-len(left) // 2)]
        scores = self.drive(left[0], CONFIRMING, CONFIRM_EPISODES)
        return left[0], scores.mean(), scores.std(ddof=1) / np.sqrt(len(scores))


def search(settings, size):
    """pycma with the run's random numbers."""
    random = np.random.Generator(np.random.PCG64(settings["seed"]))
    options = {
        "popsize": settings["population"], "CMA_diagonal": True, "seed": np.nan, "verbose": -9,
        "randn": lambda *shape: random.standard_normal(shape),
    }  # fmt: skip
    return cma.CMAEvolutionStrategy(np.zeros(size), settings["sigma0"], options)


def check_search(found):
    """Population, step size, fitness, ranks and statistics of each generation, and the mean that was evaluated."""
    strategy = search(found.settings, len(found.candidates[0, 0][0]))
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
        scored = fitness[np.isfinite(fitness)]
        expected = scored.mean(), scored.std(), scored.max(), scored.min()
        assert (mean, std, best, worst) == pytest.approx(expected, rel=1e-12)
        rows = [found.results["score", number, index] for index in np.flatnonzero(np.isfinite(fitness)).tolist()]
        assert steps == sum(each[2] for row in rows for each in row.values())
        assert {row[0][0] for row in rows} == {json.loads(seeds)[0]}, "all candidates drive the same seeds"
        last = np.nextafter(stored[np.isfinite(stored)].min(), -np.inf)  # for those that failed
        strategy.tell(asked, (-np.where(np.isfinite(stored), stored, last)).tolist())
        np.testing.assert_array_equal(found.evaluated[number][0], strategy.mean.astype("<f4"))


def check_scores(processes, name, found, answer):
    """Each place that shows an evaluation or the confirmed score has the same mean and error."""
    looks = {generation: found.look(generation) for generation in found.evaluated}
    for generation, (mean, _, deviation, _) in looks.items():
        assert found.evaluated[generation][1:] == pytest.approx((mean, deviation))
    shown, folder = json.loads(printed("runs", "show", name, "--json")), processes.folder / name
    printed("runs", "export", name, "--csv", "--out", folder)
    exported = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in folder.glob("*.csv")}
    for rows in (shown["evaluations"], exported["evaluations"]):
        assert [int(each["generation"]) for each in rows] == list(looks)
        for each in rows:
            assert [float(each["mean"]), float(each["error"])] == pytest.approx(looks[int(each["generation"])][:2])
    best = min(looks, key=found.rank)
    assert answer["best"]["generation"] == best
    assert [answer["best"]["mean"], answer["best"]["error"]] == pytest.approx(looks[best][:2])
    generation, mean, error = found.confirmed()
    with np.load(processes.runs / name / "controller.npz") as file:
        report = json.loads(str(file["about"]))["provenance"]
        np.testing.assert_array_equal(file["parameters"], found.evaluated[generation][0])
    assert (report["generation"], report["confirmed"]) == (generation, True)
    assert [report["validation_mean"], report["validation_error"]] == pytest.approx([mean, error])
    for each in (answer["confirmed"], shown["confirmed"], *exported["confirmation"]):
        assert int(each["generation"]) == generation
        assert [float(each["mean"]), float(each["error"])] == pytest.approx([mean, error])
    assert f"{mean:.1f} ± {error:.1f}" in printed("runs", "show", name)


def check_status(processes, name, found):
    """A coordinator that goes on and waits for workers tells the same of what was."""
    coordinator = processes.resume(name, "--generations", 99)
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
    assert status["last"].get("failed", 0) == np.isnan(fitness).sum()
    fitness = fitness[np.isfinite(fitness)]
    shown = [status["last"][each] for each in ("mean", "std", "best", "worst")]
    assert shown == pytest.approx([fitness.mean(), fitness.std(), fitness.max(), fitness.min()])


@pytest.mark.slow
def test_a_run_is_what_its_journal_comes_to(processes, random_bundle):
    answer = started(processes, "plain", random_bundle)
    found = Recomputed(processes.runs / "plain" / "journal.sqlite")
    assert len(found.generations) == 7
    check_search(found)
    check_scores(processes, "plain", found, answer)
    check_status(processes, "plain", found)


@pytest.mark.slow
def test_a_run_with_failures_is_what_its_journal_comes_to(processes, random_bundle):
    answer = started(
        processes, "brittle", random_bundle, "--evaluation-episodes", 9, "--failure-limit", 1, "--generations", 4,
        task=BRITTLE,
    )  # fmt: skip
    found = Recomputed(processes.runs / "brittle" / "journal.sqlite")
    kinds = {kind for kind, _, _ in found.failed}
    assert kinds == {"score", "evaluate"}, "choose another seed"
    assert any("it gets other seeds" in each for each in found.events), "choose another seed"
    check_search(found)
    check_scores(processes, "brittle", found, answer)
    check_status(processes, "brittle", found)
