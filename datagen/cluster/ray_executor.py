"""Run attempts as Ray tasks, on this machine or on a cluster.

Ray retries nothing (`max_retries=0`): the driver retries, and a hidden retry would falsify the cost. A hung
native call ignores a soft cancellation and leaks its CPU slot, so attempts are always killed.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from datagen.cluster.attempt_guard import (
    Meter,
    Note,
    clear_notes,
    collect_post_mortem,
    failure_report,
    guarded,
)
from datagen.cluster.protocol import AttemptOrder, AttemptReport, AttemptResult
from datagen.cluster.ray_cluster import RaySettings, first_line, ray_cluster
from datagen.cluster.ray_nodes import OtherNodes, attempts_begun, end_attempts, perform, post_mortems_of
from datagen.schemas.errors import InputError
from datagen.schemas.run_records import Outcome

_SLOTS_SEEN_FOR_S = 5.0
_BEGUN_SEEN_FOR_S = 1.0
# A forced cancellation normally kills a worker at once; after this, it is killed by the pid in its note.
_CANCELLED_WITHIN_S = 1.0
# Timeout for other machines, which may have to start a process first.
_BEGUN_WITHIN_S, _POST_MORTEM_WITHIN_S, _FORGOTTEN_WITHIN_S = 10.0, 15.0, 5.0
# A wait costs time for every attempt in flight, so it is for a share of them.
_SHARE_AWAITED = 32

T = TypeVar("T", bound=AttemptOrder)


@dataclass(frozen=True)
class _Death(Generic[T]):
    """Ray's result for an attempt without a worker's report."""

    task: T
    outcome: Outcome
    cause: str


@contextmanager
def ray_executor(
    function: Callable[[T, Meter], AttemptResult], settings: RaySettings
) -> Generator[RayExecutor[T]]:
    """Give an executor over `ray_cluster(settings)`; a local cluster that dies is restarted."""
    with ExitStack() as stack:

        def restart() -> Any:
            stack.close()
            return stack.enter_context(ray_cluster(settings))

        ray = stack.enter_context(ray_cluster(settings))
        executor = RayExecutor(function, settings, ray, restart if settings.address == "local" else None)
        try:
            yield executor
        finally:
            executor.close()


class RayExecutor(Generic[T]):
    """Executor over a Ray cluster that is open as long as `ray_cluster`.

    If the cluster dies, all attempts in flight are lost. `restart` starts another one; without it the reports
    end the job. A machine of a running cluster that cannot make shards of the run gets no further attempt; if
    there is no other one, its report ends the job.
    """

    def __init__(
        self,
        function: Callable[[T, Meter], AttemptResult],
        settings: RaySettings,
        ray: Any,
        restart: Callable[[], Any] | None = None,
    ) -> None:
        self._function, self._settings, self._restart = function, settings, restart
        self._left_out: set[str] = set()  # ids of unfit machines
        attempts = settings.attempts_per_worker
        memory = settings.task_memory_bytes if restart is None else 0
        self._options: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "max_calls": attempts}
        self._options["memory"] = memory
        self._tasks: dict[Any, T] = {}  # by the reference to the result
        self._refs: dict[str, Any] = {}  # by attempt
        self._killed: dict[str, float] = {}  # attempts to kill, and when to kill them by their notes
        self._begun_elsewhere: set[str] = set()
        self._begun_until_s = 0.0
        self._jobs: set[str] = set()  # folder names of notes
        self._join(ray)

    def _join(self, ray: Any) -> None:
        self._ray, self._work = ray, ray.remote(**self._options)(perform())
        self._slots, self._slots_until_s = 1, 0.0
        self.others = OtherNodes(ray, self._settings.address)

    @property
    def slots(self) -> int:
        if time.monotonic() >= self._slots_until_s and not self.others.own.silent():
            slots, memory = self._fit_slots(), f"{self._options['memory'] / 2**30:g} GiB of memory"
            if not slots and self._slots:
                self._settings.tell(f"waiting for a machine of the cluster with a CPU and {memory}")
            self._slots = slots
            # Other clusters grow and shrink.
            seen_for_s = _SLOTS_SEEN_FOR_S if self._restart is None else float("inf")
            self._slots_until_s = time.monotonic() + seen_for_s
        return max(1, self._slots)

    def submit(self, task: T) -> None:
        options: dict[str, Any] = {"name": f"shard {task.shard}"}
        if self._left_out:
            options["label_selector"] = {"ray.io/node-id": f"!in({','.join(sorted(self._left_out))})"}
        packed = self._ray.cloudpickle.dumps((guarded, self._function, task))
        ref = self._work.options(**options).remote(packed)
        self._tasks[ref], self._refs[task.attempt] = task, ref
        self._jobs.add(task.notes)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        if not self._tasks:
            time.sleep(timeout_s)
            return []
        if dead := self.others.own.dead():
            return self._lose_all(dead)
        self._end_stubborn()
        refs = list(self._tasks)
        ready, _ = self._ray.wait(refs, num_returns=max(1, len(refs) // _SHARE_AWAITED), timeout=timeout_s)
        if ready:  # also take all others that have ended
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        ended = [self._result(ref) for ref in ready]
        reports = [result for result in ended if not isinstance(result, _Death)]
        return reports + self._failure_reports([result for result in ended if isinstance(result, _Death)])

    def has_begun(self, attempt: str) -> bool:
        ref = self._refs.get(attempt)
        if ref is None:
            return False
        if attempts_begun(self._tasks[ref].notes, [attempt]):
            return True
        if time.monotonic() >= self._begun_until_s:  # checked for all attempts, at intervals
            self._begun_elsewhere = {
                begun
                for notes, flying in self._by_notes(self._tasks.values()).items()
                for answer in self.others.ask(
                    attempts_begun, notes, flying, patience_s=_BEGUN_WITHIN_S
                ).values()
                for begun in answer
            }
            self._begun_until_s = time.monotonic() + _BEGUN_SEEN_FOR_S
        return attempt in self._begun_elsewhere

    def kill(self, attempt: str) -> None:
        ref = self._refs.get(attempt)
        if ref is None:
            return
        self._killed[attempt] = time.monotonic() + _CANCELLED_WITHIN_S
        self._ray.cancel(ref, force=True)
        end_attempts(self._tasks[ref].notes, [attempt])  # a stopped process ignores Ray

    def close(self) -> None:
        """Remove the notes of the job's workers on other machines."""
        for notes in self._jobs - {""}:
            self.others.ask(clear_notes, notes, patience_s=_FORGOTTEN_WITHIN_S)
        self._jobs.clear()

    def _end_stubborn(self) -> None:
        """Kill attempts on other machines that outlived their cancellation, by their notes."""
        now_s = time.monotonic()
        due = [attempt for attempt, when_s in self._killed.items() if when_s <= now_s]
        if not due:
            return
        self._killed.update(dict.fromkeys(due, float("inf")))
        stubborn = [self._tasks[ref] for a in due if (ref := self._refs.get(a)) is not None]
        for notes, attempts in self._by_notes(stubborn).items():
            self.others.send(end_attempts, notes, attempts)  # without waiting

    def _lose_all(self, cause: str) -> list[AttemptReport]:
        refs = list(self._tasks)
        ended = [self._result(r) for r in refs and self._ray.wait(refs, num_returns=len(refs), timeout=0)[0]]
        reports = [result for result in ended if not isinstance(result, _Death)]
        deaths = [result for result in ended if isinstance(result, _Death)]
        deaths += [
            _Death(task, "cancelled" if task.attempt in self._killed else "lost", cause)
            for task in self._tasks.values()
        ]
        for known in (self._tasks, self._refs, self._killed):
            known.clear()
        ends_job = self._restart is None
        if self._restart is not None:
            try:
                self._join(self._restart())
            except InputError as error:
                ends_job, cause = True, f"{cause}, and Ray cannot be restarted: {error}"
        for death in deaths:
            end_attempts(death.task.notes, [death.task.attempt])  # a worker may outlive its raylet
            report = failure_report(death.task, death.outcome, death.cause)
            reports.append(replace(report, cause=cause, ends_job=True) if ends_job else report)
        return reports

    def _result(self, ref: Any) -> AttemptReport | _Death[T]:
        task, e = self._tasks.pop(ref), self._ray.exceptions
        del self._refs[task.attempt]
        killed = self._killed.pop(task.attempt, None) is not None
        try:
            node, address, report = self._ray.get(ref)
        except e.RayTaskError as error:  # outside the guard
            return _Death(task, "failed", f"{type(error.cause).__name__}: {error.cause}")
        except e.TaskCancelledError:
            return _Death(task, "cancelled", "killed")
        except e.OutOfMemoryError as error:
            return _Death(task, "out_of_memory", first_line(error))
        except e.WorkerCrashedError:
            if killed:
                return _Death(task, "cancelled", "killed")
            died = "the worker process died (killed, as by the kernel for lack of memory, or in native code)"
            return _Death(task, "crashed", died)
        except e.RayError as error:  # node, raylet, owner or object lost: not the shard's fault
            return _Death(task, "lost", f"{type(error).__name__}: {first_line(error)}")
        if isinstance(report, str):  # the package, or the function, could not be loaded there
            report = replace(failure_report(task, "failed", report), is_unfit=True, ends_job=True)
        if not report.is_unfit or self._restart is not None:
            return report
        cause = f"{address} (node {node[:12]}): {report.cause}"
        if node not in self._left_out:
            self._left_out.add(node)
            self._slots_until_s = 0.0
            self._settings.tell(f"left out: machine {cause}")
        if self._fit_slots():
            return replace(report, outcome="lost", ends_job=False, cause=f"unfit machine {cause}")
        return replace(report, cause=f"no machine of the cluster is fit. {cause}")

    def _fit_slots(self) -> int:
        """Attempts that can run at the same time on machines that are not left out."""
        bytes_each, slots = max(1, self._options["memory"]), 0
        for node in self._ray.nodes():
            if node["Alive"] and node["NodeID"] not in self._left_out:
                has = node["Resources"]
                slots += int(min(has.get("CPU", 0), has.get("memory", 0) // bytes_each))
        return slots if self._settings.workers is None else min(slots, self._settings.workers)

    def _failure_reports(self, deaths: list[_Death[T]]) -> list[AttemptReport]:
        """Reports of dead attempts from their files here; other machines are asked for the rest."""
        left = {d.task.attempt: collect_post_mortem(d.task.notes, d.task.attempt) for d in deaths}
        unknown = [d.task for d in deaths if left[d.task.attempt].host is None and d.outcome != "lost"]
        for notes, attempts in self._by_notes(unknown).items():
            answers = self.others.ask(post_mortems_of, notes, attempts, patience_s=_POST_MORTEM_WITHIN_S)
            for found in answers.values():
                left |= found
        return [_report_of(death, left[death.task.attempt]) for death in deaths]

    @staticmethod
    def _by_notes(tasks: Iterable[T]) -> dict[str, list[str]]:
        found: dict[str, list[str]] = defaultdict(list)
        for task in tasks:
            if task.notes:
                found[task.notes].append(task.attempt)
        return found


def _report_of(death: _Death[Any], left: Note) -> AttemptReport:
    outcome, cause = death.outcome, death.cause
    # An attempt has a note from its begin to its end: without one, the shard did not crash the worker.
    if outcome == "crashed" and left.host is None and death.task.notes:
        outcome, cause = "lost", "its worker died before it began or after it ended, or with its machine"
    return failure_report(death.task, outcome, cause, left)
