"""What a finished run leaves for people: the summary, the learning curve and an episode to watch."""

from __future__ import annotations

import numpy as np

from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds.yardsticks import yardstick_returns

YARDSTICK_EPISODES = 1000


def write_report(training: Training, folder: RunFolder) -> None:
    """Writes summary.json, learning_curve.png and the pictures of an episode into the run's folder."""
    # Drawing libraries take a second to load, which a trainer does not need before its end.
    from dae_ros.report.episode import draw_animation, draw_strip, record_episodes
    from dae_ros.report.learning_curve import plot_learning_curve
    from dae_ros.report.metrics import read_metrics
    from dae_ros.report.summary import Summary

    settings, returns = training.settings, training.evaluation
    task = settings.task
    yardsticks = yardstick_returns(task, YARDSTICK_EPISODES, settings.run.seed)
    evaluated = len(returns) > 0
    summary = Summary(
        task=task.task, num_agents=task.num_agents, beta=settings.learner.beta, seed=settings.run.seed,
        environment_steps=training.environment_steps, seconds=training.seconds, steps_per_second=training.steps_per_second,
        policy='greedy' if settings.run.evaluation_greedy else 'sampling',
        evaluation_return=float(returns.mean()) if evaluated else None,
        evaluation_standard_error=float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else None,
        evaluation_episodes=len(returns), yardsticks={name: list(value) for name, value in yardsticks.items()},
        weights_sha256=training.weights_sha256(),
        evaluation_win_rate=training.evaluation_win_rate)
    summary.write(folder.summary_file)
    title = f'{task.task}, {task.num_agents} robots, beta {settings.learner.beta:g}, seed {settings.run.seed}'
    plot_learning_curve(read_metrics(folder.metrics_file), yardsticks, title, folder.path / 'learning_curve.png')
    episodes = record_episodes(task, training.policy, settings.run.seed)
    draw_strip(episodes, folder.path / 'episode.png')
    if episodes.positions is not None:
        draw_animation(episodes, folder.path / 'episode.gif')
