"""Colours of the report: one theme for light and one for dark screens, shared by the page and its charts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours, as ``#rrggbb``.

    Attributes:
        page: background of the page.
        card: background of its boxes and of the charts.
        marked: background of what stands out.
        ink: text.
        muted: secondary text.
        faint: lines and grids.
        ground_truth: the ground truth's curves.
        estimate: the estimate's curves.
        lost: lost frames.
        green: a further colour of curves.
        orange: a further colour of curves.
        violet: a further colour of curves.
        pink: a further colour of curves.
    """

    page: str
    card: str
    marked: str
    ink: str
    muted: str
    faint: str
    ground_truth: str
    estimate: str
    lost: str
    green: str
    orange: str
    violet: str
    pink: str

    def style(self) -> dict[Any, Any]:  # matplotlib's type stubs list every key
        """Return the matplotlib settings for charts in this theme."""
        return {
            'font.family': 'DejaVu Sans',
            'font.size': 9,
            'text.color': self.ink,
            'axes.facecolor': self.card,
            'axes.edgecolor': self.ground_truth,
            'axes.labelcolor': self.muted,
            'axes.titlecolor': self.ink,
            'axes.titlesize': 11,
            'axes.titleweight': 'bold',
            'axes.titlelocation': 'left',
            'axes.titlepad': 8,
            'axes.grid': True,
            'axes.axisbelow': True,
            'axes.spines.top': False,
            'axes.spines.right': False,
            'grid.color': self.faint,
            'grid.linewidth': 0.8,
            'xtick.color': self.muted,
            'ytick.color': self.muted,
            'legend.frameon': True,
            'legend.framealpha': 0.85,
            'legend.edgecolor': 'none',
            'legend.fontsize': 8.5,
        }


LIGHT = Theme(
    page='#f4f5f7', card='#ffffff', marked='#fff6e0', ink='#1b1f24', muted='#66707c', faint='#e3e6ea',
    ground_truth='#9aa2ad', estimate='#1769e0', lost='#e5484d', green='#30a46c', orange='#f5a524', violet='#8e4ec6',
    pink='#d6409f',
)  # fmt: skip
DARK = Theme(
    page='#101317', card='#191d23', marked='#33291a', ink='#e8ebee', muted='#9aa4af', faint='#2c323a',
    ground_truth='#77818d', estimate='#5b9bff', lost='#ff6369', green='#3dd68c', orange='#ffb224', violet='#b983e8',
    pink='#f065b8',
)  # fmt: skip
