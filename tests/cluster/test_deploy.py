"""The files that start a job on a cluster: each is held against a schema or a linter, and our own program."""

from __future__ import annotations

import copy
import importlib.util
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from datagen.cli import VERBS, build_app

REPOSITORY = Path(__file__).resolve().parents[2]
DEPLOY = REPOSITORY / "datagen" / "cluster" / "deploy"
PAGE = REPOSITORY / "docs" / "guides" / "clusters.md"
DOCKERFILE = DEPLOY / "kubernetes" / "Dockerfile"
SLURM = DEPLOY / "slurm" / "datagen.sbatch"
LAUNCHERS = ("aws", "on-premise")


def load_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def lint(*command: str) -> str:
    """Run a linter that the environment brings; what it has to say."""
    program = Path(sys.executable).parent / command[0]
    done = subprocess.run([program, *command[1:]], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def refuse_unknown_words(line: str) -> None:
    """Fail unless the line is a command of ours, with options that its verb has."""
    words = shlex.split(line)
    assert words[0] == "datagen", line
    build_app().parse_args(words[1:], exit_on_error=False, print_error=False)


def packages_wanted() -> dict[str, tuple[str, ...]]:
    path = REPOSITORY / "scripts" / "system_libraries.py"
    spec = importlib.util.spec_from_file_location("system_libraries", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {library: names for library, (_, names) in module.LIBRARIES.items()}


# The image.


def test_the_image_passes_its_linter() -> None:
    assert lint("hadolint", str(DOCKERFILE)) == ""
    assert "DL3002" in lint_of("FROM debian:12\nUSER root\n")  # so that silence means something


def lint_of(text: str) -> str:
    program = Path(sys.executable).parent / "hadolint"
    return subprocess.run([program, "-"], input=text, capture_output=True, text=True, check=False).stdout


def test_the_image_has_what_the_program_needs_and_runs_as_nobody_special() -> None:
    lines = re.sub(r"\\\n\s*", " ", DOCKERFILE.read_text()).splitlines()
    (install,) = [line for line in lines if "apt-get install" in line]
    found = install.split("--no-install-recommends", 1)[1].split("&&")[0].split()
    wanted = packages_wanted()
    # One package a library; Debian 12 has the name without t64.
    assert len(found) == len(wanted) and all(set(names) & set(found) for names in wanted.values())
    assert "FROM python:3.11-slim-bookworm" in lines
    (pip,) = [line for line in lines if "pip install" in line]
    assert "-c constraints.txt" in pip and "torch.version.cuda" in pip
    users = [i for i, line in enumerate(lines) if line.startswith("USER ")]
    assert lines[users[-1]] == "USER 1000" and "--uid 1000" in pip
    assert not any(line.startswith(("RUN", "COPY")) and "pip" in line for line in lines[users[-1] :])
    copied = {word for line in lines if line.startswith("COPY ") for word in line.split()[1:-1]}
    assert all((REPOSITORY / name).exists() for name in copied)
    assert copied == {"datagen", "constraints.txt", "pyproject.toml", "README.md", "LICENSE"}


# Kubernetes.


@pytest.fixture
def ray_job() -> Any:
    return load_yaml(DEPLOY / "kubernetes" / "rayjob.yaml")


def test_the_ray_job_fits_together(ray_job: Any) -> None:
    spec = ray_job["spec"]
    refuse_unknown_words(spec["entrypoint"])
    words = shlex.split(spec["entrypoint"])
    assert words[words.index("--out") + 1].startswith("s3://") and "--detach" not in words
    assert words[words.index("--address") + 1] == "auto"
    cluster = spec["rayClusterSpec"]
    assert cluster["rayVersion"] == version("ray") and cluster["authOptions"] == {"mode": "token"}
    head, (workers,) = cluster["headGroupSpec"], cluster["workerGroupSpecs"]
    assert head["serviceType"] == "ClusterIP" and head["enableIngress"] is False
    assert head["rayStartParams"]["num-cpus"] == "0"
    assert workers["minReplicas"] <= workers["replicas"] <= workers["maxReplicas"]
    for group in (head, workers):
        pod = group["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] is True and pod["securityContext"]["runAsUser"] == 1000
        (container,) = pod["containers"]
        assert container["image"] == "IMAGE" and container["securityContext"]["capabilities"]["drop"] == [
            "ALL"
        ]
        assert container["envFrom"] == [{"secretRef": {"name": "datagen-s3"}}]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted == {volume["name"] for volume in pod["volumes"]}
        assert set(container["resources"]["requests"]) == {"cpu", "memory", "ephemeral-storage"}
    page = PAGE.read_text()
    assert "create secret generic datagen-s3" in page and "network-policy.yaml" in page


def test_only_the_cluster_itself_and_its_operator_may_speak_to_it() -> None:
    policy = load_yaml(DEPLOY / "kubernetes" / "network-policy.yaml")
    assert policy["kind"] == "NetworkPolicy" and policy["spec"]["policyTypes"] == ["Ingress"]
    (rule,) = policy["spec"]["ingress"]
    assert len(rule["from"]) == 3 and all("podSelector" in peer for peer in rule["from"])
    assert not any("ipBlock" in peer for peer in rule["from"])


# Ray's cluster launcher.


@pytest.mark.parametrize("name", LAUNCHERS)
def test_the_launcher_takes_the_file(name: str) -> None:
    from ray.autoscaler._private.util import prepare_config, validate_config

    config = load_yaml(DEPLOY / "ray" / f"{name}.yaml")
    validate_config(prepare_config(copy.deepcopy(config)))
    with pytest.raises(jsonschema.ValidationError):
        validate_config(prepare_config({**copy.deepcopy(config), "head_commands": []}))
    starts = [" ".join(config[key]) for key in ("head_start_ray_commands", "worker_start_ray_commands")]
    for start in starts:
        assert "RAY_AUTH_MODE=token" in start and "RAY_AUTH_TOKEN_PATH=" in start
        named = re.findall(r"RAY_AUTH_TOKEN_PATH=([^;\s]+)", start)
        assert set(named) <= set(config["file_mounts"])
        assert "0.0.0.0" not in start
    assert "--dashboard-host=127.0.0.1" in starts[0]


@pytest.mark.parametrize("name", LAUNCHERS)
def test_the_launchers_commands_are_ray_commands(name: str) -> None:
    from ray.scripts.scripts import cli

    config = load_yaml(DEPLOY / "ray" / f"{name}.yaml")
    for line in config["head_start_ray_commands"] + config["worker_start_ray_commands"]:
        for part in line.split(";"):
            words = shlex.split(part)
            if words and words[0].endswith("ray"):
                command = cli.commands[words[1]]
                command.make_context(words[1], words[2:], resilient_parsing=False)


# Slurm.


def test_the_batch_script_passes_its_linters() -> None:
    assert lint("shellcheck", str(SLURM)) == ""
    checked = subprocess.run(["bash", "-n", SLURM], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_the_batch_script_asks_slurm_for_what_it_needs() -> None:
    text = SLURM.read_text()
    asked = re.findall(r"^#SBATCH (.*)$", text, re.MULTILINE)
    assert {"--requeue", "--open-mode=append", "--signal=B:TERM@120", "--ntasks-per-node=1"} <= set(asked)
    assert text.index("#SBATCH") < text.index("set -euo")  # later ones would be ignored
    assert "umask 077" in text and "--include-dashboard=false" in text


# The pages.


def test_every_command_of_the_page_is_one_of_ours() -> None:
    found = re.findall(rf"\bdatagen (?:{'|'.join(VERBS)})\b[^`\n'\"]*", PAGE.read_text())
    assert found
    for line in found:
        command = line.split(" #")[0].split(" | ")[0].strip()
        if len(command.split()) > 2:  # more than the verb's name in a sentence
            refuse_unknown_words(command.replace("...", "heuristic --n 1 --out RUN"))


def test_the_page_names_all_files_and_no_others() -> None:
    text = PAGE.read_text()
    for named in re.findall(r"datagen/cluster/deploy/[\w./-]+\w", text):
        assert (REPOSITORY / named).exists(), named
    for path in DEPLOY.rglob("*"):
        if path.is_file() and path.suffix != ".py":
            assert path.name in text, f"the page does not name {path.name}"
