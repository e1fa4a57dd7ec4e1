"""What a run came to, as summary.json for scripts and as the last lines for people."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

from dae_ros.files import write_atomically
from dae_ros.report.style import signed


@dataclass(frozen=True)
class Summary:
    """The result of one run. Numbers that do not exist, such as those of an evaluation of no episodes, are None."""

    task: str
    num_agents: int
    beta: float
    seed: int
    environment_steps: int
    seconds: float
    steps_per_second: float
    policy: str                      # 'greedy' or 'sampling': how the evaluated team chose its actions
    evaluation_return: float | None
    evaluation_standard_error: float | None
    evaluation_episodes: int
    yardsticks: dict[str, list[float]]  # mean return and standard error of teams that learnt nothing
    weights_sha256: str
    evaluation_win_rate: float | None = None  # of tasks that are won or lost

    def write(self, path: Path) -> None:
        """Writes the summary as JSON."""
        write_atomically(path, (json.dumps(dataclasses.asdict(self), indent=2, allow_nan=False) + '\n').encode())

    @staticmethod
    def read(path: Path) -> Summary:
        """The summary that `write` wrote."""
        return Summary(**json.loads(path.read_text()))

    def lines(self) -> str:
        """The summary for a terminal."""
        facts = [f'task           {self.task}, {self.num_agents} robots, beta {self.beta:g}, seed {self.seed}',
                 f'trained        {self.environment_steps:,} environment steps in {self.seconds:.0f} s, '
                 f'{self.steps_per_second:,.0f} steps per second']
        teams = {name: (mean, error, '') for name, (mean, error) in self.yardsticks.items()}
        if self.evaluation_return is not None:
            won = '' if self.evaluation_win_rate is None else f', {self.evaluation_win_rate:.0%} won'
            episodes = f'   {self.policy}, {self.evaluation_episodes} fresh episodes{won}'
            teams['trained team'] = (self.evaluation_return, self.evaluation_standard_error, episodes)
        facts.append('mean return')
        for name, (mean, error, remark) in sorted(teams.items(), key=lambda team: team[1][0]):
            spread = '' if error is None else f' ± {error:.1f}'
            facts.append(f'  {name:<12} {signed(mean):>8}{spread}{remark}')
        return '\n'.join([*facts, f'weights SHA-256  {self.weights_sha256}'])
