"""Runs trainings of independent networks side by side on a few threads, with results that do not depend on how many.

Each training is a generator that yields a list of independent tasks and is sent the list of their results. Every task is
single-threaded arithmetic, so its bits do not depend on what runs beside it, and OpenMP's threads, which spin while other
processes need the core, are never started.
"""

from __future__ import annotations

import os
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, Callable, Generator, Iterable

import torch

Task = Callable[[], Any]
Training = Generator[list[Task], list[Any], Any]


class Workers:
    """A pool of `threads` worker threads (0: one per core this process may use)."""

    def __init__(self, threads: int):
        torch.set_num_threads(1)
        self._pool = ThreadPoolExecutor(threads or len(os.sched_getaffinity(0)), 'learner', torch.set_num_threads, (1,))

    def map(self, tasks: Iterable[Task]) -> list[Any]:
        """Results of the tasks, in their order."""
        return [future.result() for future in [self._pool.submit(task) for task in tasks]]

    def run(self, trainings: Iterable[Training]) -> list[Any]:
        """Drives the trainings to their ends; what each returned, in their order."""
        trainings = list(trainings)
        results: list[Any] = [None] * len(trainings)
        open_tasks: dict[Future, int] = {}
        rounds: dict[int, list[Future]] = {}

        def advance(index: int, answers: list[Any] | None) -> None:
            try:
                tasks = trainings[index].send(answers)
            except StopIteration as stop:
                results[index] = stop.value
                return
            rounds[index] = [self._pool.submit(task) for task in tasks]
            open_tasks.update((future, index) for future in rounds[index])

        for index in range(len(trainings)):
            advance(index, None)
        while open_tasks:
            finished, _ = wait(open_tasks, return_when=FIRST_COMPLETED)
            touched = sorted({open_tasks.pop(future) for future in finished})
            for index in touched:
                if all(future.done() for future in rounds[index]):
                    for future in rounds[index]:
                        open_tasks.pop(future, None)
                    advance(index, [future.result() for future in rounds[index]])
        return results

    def run_together(self, trainings: Iterable[Training], team) -> list[Any]:
        """Like `run`, on the processes of a `distributed.Team`: all trainings take each step together, this process does
        its share of the tasks, whose results are tuples of tensors, and their sums over all processes are sent back."""
        trainings = list(trainings)
        results: list[Any] = [None] * len(trainings)
        answers: dict[int, list[Any] | None] = dict.fromkeys(range(len(trainings)))
        while True:
            futures: dict[int, list[Future]] = {}
            for index, answer in answers.items():
                try:
                    tasks = trainings[index].send(answer)
                except StopIteration as stop:
                    results[index] = stop.value
                else:
                    futures[index] = [self._pool.submit(task) for task in tasks[team.rank::team.size]]
            sums = {index: [sum(parts) for parts in zip(*(future.result() for future in own))]
                    for index, own in futures.items()}
            flat = [part for parts in sums.values() for part in parts]
            if not flat:
                break
            together = torch.cat(flat)
            team.add_up(together)
            pieces = iter(together.split([len(part) for part in flat]))
            answers = {index: [tuple(next(pieces) for _ in parts)] for index, parts in sums.items()}
        return results

    def close(self) -> None:
        self._pool.shutdown()
