"""Attempts as Ray core tasks, on this machine or on a cluster.

Ray repeats nothing (`max_retries=0`): the driver owns attempts, and a hidden repetition would
falsify the account of the cost. A hung native call ignores a soft cancellation and leaks its CPU
slot, so attempts are only ever ended by force.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cluster.guard import Meter, collect_remains, guarded, obituary, resident_bytes
from cluster.ray_cluster import RaySettings, first_line
from cluster.ray_nodes import OtherNodes, attempts_begun, end_attempts, forget_job, remains_of
from cluster.task import AttemptReport, Product, Task
from schemas.run_records import Outcome

_SLOTS_SEEN_FOR_S = 5.0
_BEGUN_SEEN_FOR_S = 1.0
# A forced cancellation ends a worker that heeds Ray at once; after this, others are ended by their note.
_HEEDS_RAY_WITHIN_S = 1.0

T = TypeVar("T", bound=Task)


@dataclass(frozen=True)
class _Death(Generic[T]):
    """What Ray says of an attempt whose worker gave no report."""

    task: T
    outcome: Outcome
    cause: str


class RayExecutor(Generic[T]):
    """An executor over a Ray cluster that lives as long as `ray_cluster` is open."""

    def __init__(self, function: Callable[[T, Meter], Product], settings: RaySettings, ray: Any) -> None:
        self._ray, self._settings = ray, settings
        limit_bytes, attempts = settings.resident_limit_bytes, settings.attempts_per_worker

        def work(task: T) -> AttemptReport:
            report = guarded(function, task)
            if resident_bytes() > limit_bytes:
                retire_worker()
            return report

        options: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "max_calls": attempts}
        self._work = ray.remote(**options)(work)
        self._tasks: dict[Any, T] = {}  # by the reference to the result
        self._refs: dict[str, Any] = {}  # by attempt
        self._killed: dict[str, float] = {}  # attempts to end, and when to do so by their notes elsewhere
        self._slots, self._slots_until_s = 1, 0.0
        self._begun_elsewhere: set[str] = set()
        self._begun_until_s = 0.0
        self._jobs: set[str] = set()  # names under which notes are kept
        self.others = OtherNodes(ray, settings.address)

    @property
    def slots(self) -> int:
        if time.monotonic() >= self._slots_until_s:  # a cluster grows and shrinks
            self._slots = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
            self._slots_until_s = time.monotonic() + _SLOTS_SEEN_FOR_S
        return self._slots

    def submit(self, task: T) -> None:
        ref = self._work.options(name=f"shard {task.shard}", **self._memory(task.memory_factor)).remote(task)
        self._tasks[ref], self._refs[task.attempt] = task, ref
        self._jobs.add(task.notes)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        if not self._tasks:
            time.sleep(timeout_s)
            return []
        self._end_stubborn()
        refs = list(self._tasks)
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready:  # take along whatever else has ended
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        ended = [self._answer(ref) for ref in ready]
        deaths = [death for death in ended if isinstance(death, _Death)]
        return [r for r in ended if not isinstance(r, _Death)] + (self._obituaries(deaths) if deaths else [])

    def has_begun(self, attempt: str) -> bool:
        ref = self._refs.get(attempt)
        if ref is None:
            return False
        if attempts_begun(self._tasks[ref].notes, [attempt]):
            return True
        if time.monotonic() >= self._begun_until_s:  # many are asked about at a time
            self._begun_elsewhere = {
                begun
                for notes, flying in self._by_notes(self._tasks.values()).items()
                for answer in self.others.ask(attempts_begun, notes, flying).values()
                for begun in answer
            }
            self._begun_until_s = time.monotonic() + _BEGUN_SEEN_FOR_S
        return attempt in self._begun_elsewhere

    def kill(self, attempt: str) -> None:
        ref = self._refs.get(attempt)
        if ref is None:
            return
        self._killed[attempt] = time.monotonic() + _HEEDS_RAY_WITHIN_S
        self._ray.cancel(ref, force=True)
        end_attempts(self._tasks[ref].notes, [attempt])  # a stopped process does not heed Ray

    def close(self) -> None:
        """Remove what the job's workers left on other machines."""
        for notes in self._jobs - {""}:
            self.others.ask(forget_job, notes)
        self._jobs.clear()

    def _end_stubborn(self) -> None:
        """End by their notes those on other machines that have outlived their cancellation."""
        now_s = time.monotonic()
        due = [attempt for attempt, when_s in self._killed.items() if when_s <= now_s]
        if not due:
            return
        self._killed.update(dict.fromkeys(due, float("inf")))
        stubborn = [self._tasks[ref] for a in due if (ref := self._refs.get(a)) is not None]
        for notes, attempts in self._by_notes(stubborn).items():
            self.others.tell(end_attempts, notes, attempts)

    def _memory(self, factor: float) -> dict[str, int]:
        if not self._settings.memory_bytes:
            return {}
        # A demand that no machine can meet would wait for ever.
        largest = max((n["Resources"].get("memory", 0) for n in self._ray.nodes() if n["Alive"]), default=0)
        return {"memory": int(min(self._settings.memory_bytes * factor, largest))}

    def _answer(self, ref: Any) -> AttemptReport | _Death[T]:
        task, e = self._tasks.pop(ref), self._ray.exceptions
        del self._refs[task.attempt]
        killed = self._killed.pop(task.attempt, None) is not None
        try:
            return self._ray.get(ref)
        except e.RayTaskError as error:  # outside the guard: the task or its module did not arrive whole
            return _Death(task, "failed", f"{type(error.cause).__name__}: {error.cause}")
        except e.TaskCancelledError:
            return _Death(task, "cancelled", "ended by force")
        except e.OutOfMemoryError as error:
            return _Death(task, "out_of_memory", first_line(error))
        except e.WorkerCrashedError:
            if killed:
                return _Death(task, "cancelled", "ended by force")
            return _Death(task, "crashed", "the worker process died (killed, or ended by native code)")
        except e.RayError as error:  # node, raylet, owner or object gone: the shard is not to blame
            return _Death(task, "lost", f"{type(error).__name__}: {first_line(error)}")

    def _obituaries(self, deaths: list[_Death[T]]) -> list[AttemptReport]:
        """Reports of dead attempts from what they left, on this machine or, asked in one go, on others."""
        left = {d.task.attempt: collect_remains(d.task.notes, d.task.attempt) for d in deaths}
        elsewhere = [d.task for d in deaths if left[d.task.attempt].note is None]
        if elsewhere and self.others.alive():
            for notes, attempts in self._by_notes(elsewhere).items():
                for answer in self.others.ask(remains_of, notes, attempts).values():
                    left |= answer
            # A worker that died left its note on its machine. Where none has it, the machine went too.
            gone = "its worker and the machine that had it are gone"
            for i, d in enumerate(deaths):
                if d.outcome == "crashed" and left[d.task.attempt].note is None:
                    deaths[i] = _Death(d.task, "lost", gone)
        return [obituary(d.task, d.outcome, d.cause, left[d.task.attempt]) for d in deaths]

    @staticmethod
    def _by_notes(tasks: Iterable[T]) -> dict[str, list[str]]:
        found: dict[str, list[str]] = defaultdict(list)
        for task in tasks:
            if task.notes:
                found[task.notes].append(task.attempt)
        return found


def retire_worker() -> None:
    """Let this Ray worker process end once its present task has been answered.

    Ray ends a worker when its count of executions reaches `max_calls`; there is no public way to
    ask for it, so the count is put to the last before the end.
    """
    import ray

    manager = ray._private.worker.global_worker.function_actor_manager  # pyright: ignore
    for function_id, info in manager._function_execution_info.items():  # pyright: ignore
        if info.max_calls:
            manager._num_task_executions[function_id] = info.max_calls - 1  # pyright: ignore
