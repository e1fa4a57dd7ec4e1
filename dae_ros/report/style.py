"""How the pictures of a run look: colours that stay apart for the colour-blind, axes without clutter, typeset numbers."""

from __future__ import annotations

from matplotlib.axes import Axes

INK = '#222222'
GREY = '#8a8a8a'
FAINT = '#d9d9d9'
# After Okabe and Ito (2008), without their black and yellow; robots beyond the seventh begin anew.
BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, SAND = ROBOTS = (
    '#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#D55E00', '#B7A57A')


def plain(axes: Axes) -> None:
    """Take away from `axes` what does not help to read them."""
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
    for side in ('left', 'bottom'):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=8, length=3)
    axes.set_axisbelow(True)


def signed(value: float, digits: int = 1) -> str:
    """`value` with a true minus sign."""
    return f'{value:.{digits}f}'.replace('-', '\N{MINUS SIGN}')


def compact(value: float, _position: int | None = None) -> str:
    """A large count in few characters, as in 250k and 1.5M; also a matplotlib tick format."""
    for unit, letter in ((1e9, 'G'), (1e6, 'M'), (1e3, 'k')):
        if abs(value) >= unit:
            return f'{value / unit:g}{letter}'
    return f'{value:g}'


def rounded(steps: int) -> str:
    """A count for a line of progress: three digits are what fits into a terminal of 80 columns."""
    return compact(float(f'{steps:.3g}'))
