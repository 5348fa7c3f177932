"""Client of Ray's Jobs API, which runs commands on a cluster."""

from __future__ import annotations

import http.client
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from datagen.cluster.ray_cluster import first_line, known_token
from datagen.cluster.ray_settings import JOB_ENVIRONMENT, changed_environment
from datagen.schemas.errors import InputError

_FIX = "Give the cluster's dashboard, http://HOST:8265, and its token as RAY_AUTH_TOKEN where it requires one"
# A newly started head has no agent yet.
_AGENT_WITHIN_S = 60.0
_ANSWER_WITHIN_S = 10.0
_WORK = ("PENDING", "RUNNING")
ENDED = ("SUCCEEDED", "FAILED", "STOPPED")
# Ray prefers these to the given address.
_OVERRIDES = ("RAY_ADDRESS", "RAY_API_SERVER_ADDRESS")


class RayJobs:
    """The jobs of one cluster. Make it with `open_ray_jobs`."""

    def __init__(self, url: str, client: Any) -> None:
        self.url = url
        self._client = client

    def submit(self, entrypoint: str, submission: str, environment: Mapping[str, str]) -> None:
        """Run a shell command on the cluster's head as the job named `submission`.

        Other users may see the variables, so they must not contain secrets.
        """
        runtime: dict[str, Any] = {"env_vars": dict(environment)}
        if JOB_ENVIRONMENT in environment:
            runtime["worker_process_setup_hook"] = "datagen.cluster.ray_settings.adopt_job_environment"
        until_s = time.monotonic() + _AGENT_WITHIN_S
        with self._refusing("", "See the cluster's dashboard"):
            while True:
                try:
                    self._client.submit_job(
                        entrypoint=entrypoint, submission_id=submission, runtime_env=runtime
                    )
                    return
                except RuntimeError as error:
                    if "No available agent" not in str(error) or time.monotonic() >= until_s:
                        raise
                    time.sleep(0.5)

    def state(self, submission: str) -> str:
        """PENDING, RUNNING, SUCCEEDED, FAILED or STOPPED; "" for an unknown job."""
        with self._refusing(submission, _FIX):
            try:
                return str(self._client.get_job_status(submission).value)
            except RuntimeError as error:
                if "does not exist" not in str(error):
                    raise
        return ""

    def message(self, submission: str) -> str:
        return " ".join(str(self._client.get_job_info(submission).message).split())

    def output(self, submission: str) -> str:
        with self._refusing(submission, "The cluster does not keep this job any more"):
            return str(self._client.get_job_logs(submission))

    def stop(self, submission: str) -> None:
        """Stop the command: SIGTERM, and SIGKILL some seconds later."""
        with self._refusing(submission, "See the cluster's dashboard"):
            self._client.stop_job(submission)

    @contextmanager
    def _refusing(self, submission: str, fix: str) -> Generator[None]:
        """Raise InputError for an error of the Jobs API within the block."""
        try:
            yield
        except RuntimeError as error:
            raise InputError(self.url, submission, first_line(error), fix) from error

    def at_work(self) -> list[str]:
        return [str(job.entrypoint) for job in self._client.list_jobs() if job.status.value in _WORK]


def open_ray_jobs(url: str, token: str = "") -> RayJobs:
    """Open the Jobs API of a cluster's dashboard, `http://HOST:PORT`.

    Without `token`, the one that Ray would use is sent to a dashboard that requires one. InputError where
    none responds, or it refuses the token.
    """
    if "@" in url:
        fix = "Remove it; set a token as RAY_AUTH_TOKEN"
        raise InputError("--address", "", "has a password, which would appear in records and logs", fix)
    if not url.startswith(("http://", "https://")):
        raise InputError("--address", url, "is not the address of a dashboard", _FIX)
    if not token and (found := known_token()) and dashboard_status(url) in (401, 403):
        token = found[0]
    with changed_environment(dict.fromkeys(_OVERRIDES)):
        from ray.exceptions import RayError
        from ray.job_submission import JobSubmissionClient

        try:
            client = JobSubmissionClient(url, headers=_headers(token) or None)
        except (RayError, ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise InputError("--address", url, first_line(error), _FIX) from error
        return RayJobs(str(client.get_address()), client)


def dashboard_status(url: str, token: str = "") -> int | None:
    """Status code of a dashboard's response, without a token by default; None where there is no response."""
    parts = urlsplit(url)
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    connection = kind(parts.netloc, timeout=_ANSWER_WITHIN_S)
    try:
        connection.request("GET", "/api/version", headers=_headers(token))
        return connection.getresponse().status
    except (OSError, ValueError, http.client.HTTPException):
        return None
    finally:
        connection.close()


def _headers(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"} if token else {}
