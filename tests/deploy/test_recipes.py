"""Deployment recipes, checked by linters, schemas, systemd and our own command line."""

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import kubernetes_validate
import promql_parser
import pytest
import yaml
from cloudcoil.models.keda import v1alpha1 as keda

from dreamfleet.common.cli import command_line
from dreamfleet.coordinator.addons.metrics.prometheus import exposition
from tests.support import tasks
from tests.support.processes import DEADLINE, Line, environment, started
from tests.support.samples import STATUS

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
BIN = Path(sys.executable).parent
KUBERNETES = "1.31"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
EXPOSURE = 2.0  # of 10; systemd-analyze rates up to 5 as OK


def checked(*words, **more):
    """Run a tool, which must succeed; return its output."""
    done = subprocess.run([str(each) for each in words], capture_output=True, text=True, check=False, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def document(*place):
    return yaml.safe_load(DEPLOY.joinpath(*place).read_text())


def understood(verb, words):
    """Parse the words as the verb does; it exits for an unknown one."""
    (point,) = (each for each in entry_points(group=command_line.GROUP) if each.name == verb)
    command_line.build_parser(verb, point.load()).parse_all([str(each) for each in words])


def test_the_linters_are_content():
    checked(BIN / "hadolint", "--failure-threshold", "style", DEPLOY / "Containerfile")
    checked(BIN / "shellcheck", *DEPLOY.rglob("*.sh"), ROOT / ".ci" / "run")
    checked(BIN / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", DEPLOY / "compose.yaml")
    checked(BIN / "check-jsonschema", "--builtin-schema", "vendor.github-workflows", *WORKFLOWS)


@pytest.mark.skipif(shutil.which("actionlint") is None, reason="needs actionlint on PATH")
def test_actionlint_is_content():
    checked("actionlint", "-shellcheck", BIN / "shellcheck", *WORKFLOWS)


def test_workflows_test_each_python_that_the_package_names_and_run_what_is_there():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    jobs = {name: job for path in WORKFLOWS for name, job in yaml.safe_load(path.read_text())["jobs"].items()}
    assert jobs["short"]["strategy"]["matrix"]["python"] == named
    targets = [each for job in jobs.values() for step in job["steps"]
               for each in re.findall(r"make (\w+)", step.get("run", ""))]  # fmt: skip
    assert targets
    assert all(f"\n{each}:" in (ROOT / "Makefile").read_text() for each in targets)
    (image,) = (step["with"] for step in jobs["worker"]["steps"] if "target" in step.get("with", {}))
    assert f" AS {image['target']}\n" in (ROOT / image["file"]).read_text()


def test_compose_starts_what_our_verbs_know():
    compose = document("compose.yaml")
    services = compose["services"]
    understood("coordinator", ["--run", *services["coordinator"]["command"]])
    understood("worker", services["worker"]["command"])
    stages = set(re.findall(r"^FROM \S+ AS (\S+)", (DEPLOY / "Containerfile").read_text(), re.MULTILINE))
    for service in services.values():
        assert service["build"]["target"] in stages
        assert service["read_only"]
        assert service["environment"]["DREAMFLEET_JOIN"] == f"/run/secrets/{service['secrets'][0]}"
        assert service["secrets"][0] in compose["secrets"]


def test_the_cluster_takes_what_the_kustomization_lists():
    folder = DEPLOY / "kubernetes"
    whole = document("kubernetes", "kustomization.yaml")
    listed = [each for name in whole["resources"] for each in yaml.safe_load_all((folder / name).read_text())]
    assert {*whole["resources"], "kustomization.yaml"} == {path.name for path in folder.iterdir()}
    secrets = {each["name"] for each in whole["secretGenerator"]}
    for each in (each for each in listed if each["kind"] != "ScaledObject"):
        kubernetes_validate.validate(each, KUBERNETES, strict=True)
    for kind, verb, first in (("Job", "coordinator", ["--run"]), ("Deployment", "worker", [])):
        (pod,) = (each["spec"]["template"]["spec"] for each in listed if each["kind"] == kind)
        (container,) = pod["containers"]
        understood(verb, [*first, *container["args"]])
        assert {each["name"] for each in whole["images"]} >= {container["image"]}
        assert {each["name"] for each in container["volumeMounts"]} == {each["name"] for each in pod["volumes"]}
        assert {each["secret"]["secretName"] for each in pod["volumes"] if "secret" in each} <= secrets
        ports = {each["name"] for each in container.get("ports", ())}
        probes = [each for name, each in container.items() if name.endswith("Probe") and "exec" not in each]
        asked = [each["tcpSocket" if "tcpSocket" in each else "httpGet"]["port"] for each in probes]
        assert set(asked) <= ports
        assert ("metrics" in ports) == ("--metrics-port" in container["args"])
    # What has ended stays ended: of the kinds that hold pods, a Job alone does not restart after exit code 0.
    (job,) = (each["spec"] for each in listed if each["kind"] == "Job")
    assert (job["template"]["spec"]["restartPolicy"], job["podReplacementPolicy"]) == ("OnFailure", "Failed")
    (probe,) = (each["spec"]["template"]["spec"]["containers"][0]["startupProbe"] for each in listed
                if each["kind"] == "Deployment")  # fmt: skip
    understood("doctor", probe["exec"]["command"][2:])


def test_workers_are_scaled_by_metrics_that_are_there():
    scaled = document("kubernetes", "autoscaling.yaml")
    found = keda.ScaledObject.model_validate(scaled)
    assert found.model_dump(by_alias=True, exclude_unset=True, mode="json") == scaled  # nothing that it does not know
    query = scaled["spec"]["triggers"][0]["metadata"]["query"]
    promql_parser.parse(query)
    names = set(re.findall(r"dreamfleet_[a-z_]+", query))
    text = exposition(dataclasses.replace(STATUS, run="night")).decode()
    assert names
    assert all(f'{name}{{run="night"}}' in text for name in names)


@pytest.mark.needs_programs("systemd-analyze")
@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)
def test_systemd_takes_the_units_and_finds_them_shut(unit, tmp_path):
    text = unit.read_text()
    (start,) = re.findall(r"^ExecStart=(.*)$", text, re.MULTILINE)
    program, *words = start.split()
    if Path(program).name == "dreamfleet":
        understood(words[0], words[1:])
    real = BIN / "dreamfleet" if Path(program).name == "dreamfleet" else DEPLOY / Path(program).name
    (tmp_path / unit.name).write_text(text.replace(program, str(real)))
    assert checked("systemd-analyze", "verify", "--man=no", tmp_path / unit.name) == ""
    said = checked("systemd-analyze", "security", "--offline=true", tmp_path / unit.name)
    assert float(re.search(r"exposure level for \S+: ([0-9.]+)", said)[1]) <= EXPOSURE


def test_the_spot_machine_runs_the_unit():
    machine = document("cloud-init", "worker.yaml")
    written = {each["path"]: each for each in machine["write_files"]}
    unit = written["/etc/systemd/system/dreamfleet-worker.service"]["content"]
    own = (DEPLOY / "systemd" / "dreamfleet-worker.service").read_text()
    assert unit == own[own.index("[Unit]") :]
    assert written["/etc/dreamfleet/worker.join"]["permissions"] == "0600"
    for words in machine["runcmd"]:
        if words[0].endswith("/dreamfleet"):
            understood(words[1], words[2:])


@pytest.mark.long
def test_cloud_init_takes_the_user_data(tmp_path):
    """Checked with cloud-init's schema, installed or from Debian's package."""
    schema = "usr/lib/python3/dist-packages/cloudinit/config/schemas/schema-cloud-config-v1.json"
    where = Path("/", schema)
    if not where.exists():
        if shutil.which("apt-get") is None:
            pytest.skip("needs cloud-init, or Debian's package of it")
        subprocess.run(["apt-get", "download", "cloud-init"], cwd=tmp_path, check=True, capture_output=True)
        (package,) = tmp_path.glob("*.deb")
        subprocess.run(["dpkg-deb", "--extract", package, tmp_path], check=True)
        where = tmp_path / schema
    checked(BIN / "check-jsonschema", "--schemafile", where, DEPLOY / "cloud-init" / "worker.yaml")


@pytest.mark.slow
def test_one_command_begins_a_run_and_goes_on_with_it(processes, random_bundle):
    """Restarted after every stop, as a container or unit is."""
    settings = ("--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 4, "--episodes", 1,
                "--evaluate-every", 0, "--generations", 3, "--listen", processes.endpoint)  # fmt: skip
    surroundings = environment(processes.cache) | {
        "PATH": f"{BIN}:{os.environ['PATH']}", "DREAMFLEET_RUNS_DIR": str(processes.runs),
        "DREAMFLEET_LOG_FORMAT": "json",
    }  # fmt: skip
    words = [str(DEPLOY / "begin.sh"), "night", *map(str, settings)]
    with started(words, env=surroundings, stderr=subprocess.PIPE, text=True) as begun:
        while not Line(begun.stderr.readline()).is_event("begin", incarnation=1):
            assert begun.poll() is None
        begun.send_signal(signal.SIGTERM)
        assert begun.wait(DEADLINE) == 130
        begun.stderr.read()
    with started(words, env=surroundings, stderr=subprocess.PIPE, text=True) as again:
        processes.worker("--run", "night", "--task", tasks.TOY, "--exit-when-done")
        said = [Line(each) for each in again.stderr]
        assert again.wait(DEADLINE) == 0, said
    assert any(line.is_event("begin", incarnation=2) for line in said)
    assert any(line.is_event("generation", number=2) for line in said)


def test_what_a_recipe_is_and_how_it_is_tested_stands_in_the_table():
    table = (DEPLOY / "README.md").read_text()
    names = {path.name for path in DEPLOY.iterdir() if path.suffix != ".lock"} - {"README.md", "__pycache__"}
    assert {name for name in names if f"`{name}" not in table} == set()
