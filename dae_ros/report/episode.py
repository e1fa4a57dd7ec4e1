"""Shows the trained team at work: a few episodes as an animation and as a film strip."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from dae_ros.config import TaskSettings
from dae_ros.learning.policy import Policy, choose
from dae_ros.report.style import FAINT, GREY, INK, ROBOTS, plain, signed
from dae_ros.worlds import make_worlds, side_by_side
from dae_ros.worlds.particle import ParticleWorlds

EPISODES = 3            # side by side
STRIP_FRAMES = 5        # of the film strip
FRAME_MILLISECONDS = 125
LAST_FRAME_MILLISECONDS = 2000  # for looking at the result
LONGEST = 400           # steps recorded of a task that says nothing about its episodes
ROLLOUT = 2**31         # names the recorded episodes' draws, far from those of any training


class Episodes(NamedTuple):
    """M episodes of one team, each of at most T steps; what follows an episode's end is not to be shown."""

    task: str
    actions: np.ndarray           # [T, M, N]
    rewards: np.ndarray           # [T, M]
    lengths: np.ndarray           # [M] steps
    positions: np.ndarray | None  # [T + 1, M, N, 2]; None where robots have no place
    targets: np.ndarray | None    # [T + 1, M, N, 2]
    radius: float                 # of a robot


def record_episodes(task: TaskSettings, policy: Policy, seed: int) -> Episodes:
    """A few fresh episodes of the team in which every robot takes its most probable action."""
    worlds = make_worlds(side_by_side(task, EPISODES))
    try:
        return _record(task.task, worlds, policy, seed)
    finally:
        worlds.close()


def _record(task: str, worlds, policy: Policy, seed: int) -> Episodes:
    seen, robots = worlds.reset(seed, ROLLOUT), range(worlds.spec.num_agents)
    placed = isinstance(worlds, ParticleWorlds)
    states = [policy.initial_state(worlds.num_worlds) for _ in robots]
    actions, rewards, positions, targets = [], [], [], []
    lengths = np.zeros(worlds.num_worlds, int)
    while not lengths.all() and len(rewards) < LONGEST:
        if placed:
            positions.append(worlds.positions.copy())
            targets.append(worlds.targets.copy())
        joint = np.empty((worlds.num_worlds, len(robots)), np.int64)
        for robot in robots:
            available = None if seen.available is None else seen.available[:, robot]
            probabilities, states[robot] = policy.act(np.ascontiguousarray(seen.observations[:, robot]), states[robot],
                                                      seen.episode_start, available)
            joint[:, robot] = choose(probabilities, True, seed, ROLLOUT, len(rewards), robot)
        transition = worlds.step(joint)
        seen = transition.next
        actions.append(joint)
        rewards.append(transition.reward)
        lengths[(lengths == 0) & (transition.terminated | transition.truncated)] = len(rewards)
    lengths[lengths == 0] = len(rewards)
    # The worlds have begun the next episode by now, so the last place shown is where the last action was taken.
    return Episodes(task, np.array(actions), np.array(rewards), lengths, np.array(positions) if placed else None,
                    np.array(targets) if placed else None, worlds.radius if placed else 0.0)


def draw_animation(episodes: Episodes, path: Path) -> None:
    """Writes a GIF of the episodes side by side. Only for tasks whose robots have a place."""
    figure = _figure(2.7 * EPISODES, 3.0, dpi=80)
    panels = [_Panel(axes, episodes, episode) for episode, axes in enumerate(figure.subplots(1, EPISODES))]
    figure.draw_without_rendering()
    figure.set_layout_engine('none')  # laid out once: doing it for every frame takes most of the time
    frames = []
    for step in range(episodes.lengths.max()):
        for panel in panels:
            panel.show(step)
        figure.canvas.draw()
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert('P', palette=Image.Palette.ADAPTIVE))
    durations = [FRAME_MILLISECONDS] * (len(frames) - 1) + [LAST_FRAME_MILLISECONDS]
    frames[0].save(path, format='GIF', save_all=True, append_images=frames[1:], duration=durations, loop=0)


def draw_strip(episodes: Episodes, path: Path) -> None:
    """Writes a PNG of the first episode: a row of moments, or, where robots have no place, everyone's actions."""
    if episodes.positions is None:
        _draw_actions(episodes, path)
        return
    figure = _figure(2.2 * STRIP_FRAMES, 2.4, dpi=150)
    moments = np.linspace(0, episodes.lengths[0] - 1, STRIP_FRAMES).round().astype(int)
    for axes, step in zip(figure.subplots(1, STRIP_FRAMES), moments):
        _Panel(axes, episodes, 0).show(step)
    figure.savefig(path, format='png')


def _figure(width: float, height: float, dpi: int) -> Figure:
    figure = Figure(figsize=(width, height), dpi=dpi, layout='constrained')
    FigureCanvasAgg(figure)
    return figure


class _Panel:
    """One episode: targets as rings, robots as discs of their size with the way they came."""

    def __init__(self, axes: Axes, episodes: Episodes, episode: int):
        length = episodes.lengths[episode]
        self._positions = episodes.positions[:length, episode]  # [T, N, 2]
        self._targets = episodes.targets[:length, episode]      # [T, N, 2]
        self._returns = np.concatenate([[0.0], np.cumsum(episodes.rewards[:length, episode])])
        reach = max(1.15, float(np.abs(self._positions).max()) + episodes.radius)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect='equal', xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set_color(FAINT)
        self._title = axes.set_title(' ', fontsize=9, color=INK)
        ring = max(episodes.radius, 0.05) * 1.25
        self._rings = [axes.add_patch(Circle((0, 0), ring, fill=False, edgecolor=INK, linewidth=1.2)) for _ in self._targets[0]]
        self._marks, = axes.plot([], [], linestyle='', marker='+', color=INK, markersize=6, markeredgewidth=1.0)
        colours = [ROBOTS[robot % len(ROBOTS)] for robot in range(self._positions.shape[1])]
        self._trails = [axes.plot([], [], color=colour, linewidth=1.4, alpha=0.45)[0] for colour in colours]
        self._robots = [axes.add_patch(Circle((0, 0), episodes.radius, color=colour, alpha=0.85, linewidth=0))
                        for colour in colours]

    def show(self, step: int) -> None:
        """Brings the panel to `step`, or to the episode's last one."""
        step = min(step, len(self._positions) - 1)
        self._title.set_text(f'step {step}   return {signed(self._returns[step])}')
        self._marks.set_data(*self._targets[step].T)
        for ring, place in zip(self._rings, self._targets[step]):
            ring.set_center(place)
        for trail, disc, way in zip(self._trails, self._robots, self._positions[:step + 1].transpose(1, 2, 0)):
            trail.set_data(*way)
            disc.set_center(way[:, -1])


def _draw_actions(episodes: Episodes, path: Path) -> None:
    """Everyone's actions over the steps, and the team's reward beneath."""
    length = episodes.lengths[0]
    figure = _figure(8.0, 4.2, dpi=150)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1.0])
    image = top.imshow(episodes.actions[:length, 0].T, aspect='auto', cmap='cividis', interpolation='nearest')
    top.set_ylabel('robot', fontsize=9, color=INK)
    top.set_title(f'{episodes.task.partition(":")[2] or episodes.task}: actions of one episode, '
                  f'return {signed(episodes.rewards[:length, 0].sum())}', loc='left', fontsize=10, color=INK)
    figure.colorbar(image, ax=top, label='action', pad=0.01)
    plain(below)
    below.step(range(length), episodes.rewards[:length, 0], where='mid', color=ROBOTS[0])
    below.axhline(0, color=GREY, linewidth=0.6)
    below.set_xlabel('step', fontsize=9, color=INK)
    below.set_ylabel('reward', fontsize=9, color=INK)
    figure.savefig(path, format='png')
