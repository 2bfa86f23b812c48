"""An engine on Ray: the processors of a cluster; imported only where it is asked for."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from sightline._optional import module
from sightline.errors import InputError
from sightline.fleet.engines import Answer, Outcome, attempt

Item = TypeVar("Item")
Result = TypeVar("Result")

_WAITS_S = 0.5
# So that no processor waits for the driver, which keeps no more than these.
_AHEAD = 2.0
_LONGEST = 200


class RayEngine:
    """Tasks of a Ray cluster, one processor each unless told."""

    def __init__(
        self,
        address: str | None = None,
        *,
        workers: int | None = None,
        memory_mb: int | None = None,
    ) -> None:
        """Connect to a cluster, or start one on this machine.

        Args:
            address: ``HOST:PORT`` or ``ray://HOST:PORT`` of a cluster; None: one is started.
            workers: Processors of the one that is started; None: all of this machine.
            memory_mb: That a task asks for; None: nothing is asked for.

        Raises:
            InputError: Ray is not installed, or there is no cluster at the address.
        """
        # It reports to its makers, unless it is told not to before it is loaded.
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        self._ray = module("ray", "ray")
        options: dict[str, object] = {"log_to_driver": False, "logging_level": "error"}
        if address is None:
            options |= {"include_dashboard": False, "num_cpus": workers}
        else:
            options["address"] = address
        try:
            self._ray.init(**options)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            reason = " ".join(str(error).split())[:_LONGEST]
            raise InputError(f"no Ray cluster can be had at {address}: {reason}") from error
        self._memory = None if memory_mb is None else memory_mb * 1_000_000

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        retries: int = 2,
        stop: threading.Event | None = None,
    ) -> Iterator[Outcome[Item, Result]]:
        """See `Engine`; the function goes through the object store, once."""
        ray = self._ray
        put = ray.put(function)
        remote = ray.remote(max_retries=0, num_cpus=1, memory=self._memory)(attempt)
        waiting, running = iter(items), dict[Any, tuple[Item, int]]()
        again: list[tuple[Item, int]] = []
        while stop is None or not stop.is_set():
            while len(running) < _AHEAD * self._processors():
                item, attempts = again.pop() if again else (next(waiting, None), 0)
                if item is None:
                    break
                running[remote.remote(put, item)] = (item, attempts + 1)
            if not running:
                return
            done, _ = ray.wait(list(running), num_returns=1, timeout=_WAITS_S)
            for reference in done:
                item, attempts = running.pop(reference)
                answer = self._answer(reference)
                if answer.retry and attempts <= retries:
                    again.append((item, attempts))
                    continue
                yield Outcome(item, answer.result, answer.line, attempts, answer.bug)

    def close(self) -> None:
        """See `Engine`."""
        self._ray.shutdown()

    def _processors(self) -> float:
        """Of the cluster, as it is now: nodes come and go."""
        return max(float(self._ray.cluster_resources().get("CPU", 1.0)), 1.0)

    def _answer(self, reference: Any) -> Answer[Any]:
        try:
            answer: Answer[Any] = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            return Answer(None, " ".join(str(error.cause).split())[:_LONGEST], bug=True)
        except self._ray.exceptions.RayError as error:
            # The worker or its node has died, or had no memory left.
            time.sleep(_WAITS_S)
            line = f"{type(error).__name__}: {str(error).splitlines()[0][:_LONGEST]}"
            return Answer(None, line, retry=True)
        return answer
