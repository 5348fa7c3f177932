"""The files that start a job on a cluster: each is held against a schema or a linter, and our own program."""

from __future__ import annotations

import copy
import re
import runpy
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from datagen.cli import build_app

REPOSITORY = Path(__file__).resolve().parents[2]
DEPLOY = REPOSITORY / "datagen" / "cluster" / "deploy"
PAGE = REPOSITORY / "docs" / "guides" / "clusters.md"
DOCKERFILE = DEPLOY / "kubernetes" / "Dockerfile"
SLURM = DEPLOY / "slurm" / "datagen.sbatch"


def load_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def lint(*command: str | Path, text: str = "") -> str:
    """Run a linter that the environment brings; what it has to say."""
    program = Path(sys.executable).parent / command[0]
    done = subprocess.run([program, *command[1:]], input=text, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stdout + done.stderr


# The image.


def test_the_image_passes_its_linter() -> None:
    assert lint("hadolint", DOCKERFILE) == ""
    assert "DL3002" in lint("hadolint", "-", text="FROM debian:12\nUSER root\n")  # silence means something


def test_the_image_has_what_the_program_needs_and_runs_as_nobody_special() -> None:
    lines = re.sub(r"\\\n\s*", " ", DOCKERFILE.read_text()).splitlines()
    (install,) = [line for line in lines if "apt-get install" in line]
    found = install.split("--no-install-recommends", 1)[1].split("&&")[0].split()
    wanted = runpy.run_path(str(REPOSITORY / "scripts" / "system_libraries.py"))["LIBRARIES"]
    # One package a library; Debian 12 has the name without t64.
    assert len(found) == len(wanted) and all(set(names) & set(found) for _, names in wanted.values())
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


def test_the_ray_job_fits_together() -> None:
    spec = load_yaml(DEPLOY / "kubernetes" / "rayjob.yaml")["spec"]
    words = shlex.split(spec["entrypoint"])
    assert words[0] == "datagen"
    build_app().parse_args(words[1:], exit_on_error=False, print_error=False)
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


@pytest.mark.parametrize("name", ["aws", "on-premise"])
def test_the_launcher_takes_the_file_and_ray_its_commands(name: str) -> None:
    from ray.autoscaler._private.util import prepare_config, validate_config
    from ray.scripts.scripts import cli

    config = load_yaml(DEPLOY / "ray" / f"{name}.yaml")
    validate_config(prepare_config(copy.deepcopy(config)))
    with pytest.raises(jsonschema.ValidationError):
        validate_config(prepare_config({**copy.deepcopy(config), "head_commands": []}))
    starts = ["\n".join(config[key]) for key in ("head_start_ray_commands", "worker_start_ray_commands")]
    for start in starts:
        assert "RAY_AUTH_MODE=token" in start and "RAY_AUTH_TOKEN_PATH=" in start
        named = re.findall(r"RAY_AUTH_TOKEN_PATH=([^;\s]+)", start)
        assert set(named) <= set(config["file_mounts"])
        assert "0.0.0.0" not in start
    assert "--dashboard-host=127.0.0.1" in starts[0]
    for part in (part for start in starts for part in re.split(r"[;\n]", start)):
        words = shlex.split(part)
        if words and words[0].endswith("ray"):
            cli.commands[words[1]].make_context(words[1], words[2:], resilient_parsing=False)


# Slurm.


def test_the_batch_script_passes_its_linter_and_asks_slurm_for_what_it_needs() -> None:
    assert lint("shellcheck", SLURM) == ""
    text = SLURM.read_text()
    asked = re.findall(r"^#SBATCH (.*)$", text, re.MULTILINE)
    assert {"--requeue", "--open-mode=append", "--signal=B:TERM@120", "--ntasks-per-node=1"} <= set(asked)
    assert text.index("#SBATCH") < text.index("set -euo")  # later ones would be ignored
    assert "umask 077" in text and "--include-dashboard=false" in text


# The pages.


def test_the_page_names_all_files_and_no_others() -> None:
    text = PAGE.read_text()
    for named in re.findall(r"datagen/cluster/deploy/[\w./-]+\w", text):
        assert (REPOSITORY / named).exists(), named
    for path in DEPLOY.rglob("*"):
        if path.is_file() and path.suffix != ".py":
            assert path.name in text, f"the page does not name {path.name}"
