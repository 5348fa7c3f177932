"""The files that start a job on a cluster: each is held against a schema or a linter, and our own program."""

from __future__ import annotations

import copy
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jsonschema
import psutil
import pytest
import ray
import yaml

from datagen.cli import build_app
from datagen.cluster.ray_settings import OBJECT_STORE_BYTES, new_token
from datagen.jobs.job import _TASK_MEMORY_BYTES
from tests.faults.test_ray_processes import kill_machine
from tests.s3_servers import free_port

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
        for probe in ("readinessProbe", "livenessProbe"):
            assert container[probe]["exec"]["command"][:2] == ["python", "-c"]
    # The autoscaler in the head's pod asks Kubernetes for workers; these need no account.
    assert cluster["enableInTreeAutoscaling"] is True and workers["minReplicas"] < workers["maxReplicas"]
    accounts = [group["template"]["spec"].get("automountServiceAccountToken") for group in (head, workers)]
    assert accounts == [None, False]
    # What attempts request fits on a worker as often as it has cores.
    requests = workers["template"]["spec"]["containers"][0]["resources"]["requests"]
    assert 2 * _TASK_MEMORY_BYTES * int(requests["cpu"]) <= int(requests["memory"].removesuffix("Gi")) * 2**30
    page = PAGE.read_text()
    assert "create secret generic datagen-s3" in page and "network-policy.yaml" in page


@pytest.mark.slow
def test_the_probes_hold_with_nothing_but_python(tmp_path: Path) -> None:
    """Their commands, on a real head that requires a token, where only `python` is on the path."""
    cluster = load_yaml(DEPLOY / "kubernetes" / "rayjob.yaml")["spec"]["rayClusterSpec"]
    groups = (cluster["headGroupSpec"], cluster["workerGroupSpecs"][0])
    containers = [group["template"]["spec"]["containers"][0] for group in groups]
    probes = [container["readinessProbe"]["exec"]["command"] for container in containers]
    only_python = {"PATH": str(tmp_path / "bin")}
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(sys.executable)
    agent, dashboard = free_port(), free_port()

    def results() -> list[bool]:
        ended = list[bool]()
        for command in probes:
            words = [w.replace("52365/", f"{agent}/").replace("8265/", f"{dashboard}/") for w in command]
            done = subprocess.run(words, env=only_python, capture_output=True, check=False)
            ended.append(done.returncode == 0)
        return ended

    assert results() == [False, False]  # nothing listens yet
    session = Path(tempfile.mkdtemp(prefix="dg"))
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": new_token(), "PYTHONPATH": str(REPOSITORY)}
    environment = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")} | token
    head = psutil.Popen(
        [
            *(sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--num-cpus=0"),
            *("--node-ip-address=127.0.0.1", "--port=0", "--include-dashboard=true"),
            *(f"--dashboard-port={dashboard}", f"--dashboard-agent-listen-port={agent}"),
            *(f"--ray-client-server-port={free_port()}", f"--temp-dir={session}", "--disable-usage-stats"),
            f"--object-store-memory={OBJECT_STORE_BYTES}",
        ],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        while results() != [True, True]:
            assert head.poll() is None
            time.sleep(0.5)
        (server,) = [p for p in head.children(recursive=True) if p.name() == "gcs_server"]
        server.suspend()
        while results()[0]:  # a head without its server is not ready, as soon as Ray notices
            time.sleep(0.5)
    finally:
        kill_machine(head)
        shutil.rmtree(session, ignore_errors=True)


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
    schema = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
    jsonschema.validate(config, schema)  # as it is, before Ray completes it
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


def test_the_launcher_fills_in_the_aws_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import boto3
    from moto import mock_aws
    from ray.autoscaler._private.aws.config import bootstrap_aws
    from ray.autoscaler._private.util import prepare_config

    for name, value in {
        "HOME": str(tmp_path),
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
    }.items():
        monkeypatch.setenv(name, value)
    (tmp_path / ".ssh").mkdir()
    config = load_yaml(DEPLOY / "ray" / "aws.yaml")
    with mock_aws():
        filled = bootstrap_aws(prepare_config(copy.deepcopy(config)))
        assert list(boto3.resource("iam").roles.all()) == []  # Ray's own role could not pass on the workers'
    nodes = [node["node_config"] for node in filled["available_node_types"].values()]
    assert len(nodes) == 2
    for node in nodes:
        assert node["ImageId"].startswith("resolve:ssm:") and node["IamInstanceProfile"]
        assert node["SecurityGroupIds"] and node["SubnetIds"] and node["KeyName"]


def test_the_head_may_pass_the_role_of_the_workers_on_and_no_other() -> None:
    policy = json.loads((DEPLOY / "ray" / "aws-head-policy.json").read_text())
    worker = load_yaml(DEPLOY / "ray" / "aws.yaml")["available_node_types"]["worker"]["node_config"]
    (passes,) = [rule for rule in policy["Statement"] if rule["Action"] == "iam:PassRole"]
    assert passes["Effect"] == "Allow"
    assert passes["Resource"].endswith(f":role/{worker['IamInstanceProfile']['Name']}")


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
