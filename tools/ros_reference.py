"""Writes the tables of docs/ros.md from the code. With ``--check`` only reports whether they are out of date.

Run as ``python tools/ros_reference.py``. Everything between ``<!-- generated: NAME -->`` and ``<!-- end -->`` is
replaced by what ``SECTIONS[NAME]`` returns; the text around it is written by hand. To add a table, write a function that
returns Markdown, and add a line to ``SECTIONS`` and the two markers to docs/ros.md.
``test/ros/test_reference.py`` fails if the page is out of date; ``test_outputs.py`` compares its topics with a running node.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from splatam_core.settings import Setting
from splatam_ros import interface
from splatam_ros.cameras import CAMERAS
from splatam_ros.node.outputs import OUTPUTS
from splatam_ros.node.parameters import NODE_SETTINGS, why_fixed
from splatam_ros.node.services import SERVICES

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs' / 'ros.md'
FEATURES = ROOT / 'test' / 'ros' / 'features.yaml'
FAULTS = ROOT / 'test' / 'ros' / 'faults.yaml'
SECTION = re.compile(r'(<!-- generated: (\w+) -->\n).*?(<!-- end -->)', re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return ''.join(f'| {" | ".join(cell.replace("|", chr(92) + "|") for cell in line)} |\n' for line in lines)


def inputs() -> str:
    """Returns the table of subscribed topics."""
    return table(('topic', 'type', ''), ((f'`{topic.name}`', topic.type_name, topic.help) for topic in interface.INPUTS))


def outputs() -> str:
    """Returns the table of published topics."""
    own = [(f'`~/{output.topic}`', output.type_name, output.trigger.value, output.help) for output in OUTPUTS]
    shared = [(f'`{topic.name}`', topic.type_name, topic.when, topic.help) for topic in interface.SHARED_OUTPUTS]
    return table(('topic', 'type', 'when', ''), [*own, *shared])


def parameters() -> str:
    """Returns the table of the node's own parameters."""
    return table(('parameter', 'default', 'allowed', 'at run time', ''), map(_parameter, NODE_SETTINGS))


def _parameter(setting: Setting) -> Sequence[str]:
    default = setting.shown_default if setting.default == '' else f'`{setting.shown_default}`'
    changes = '' if why_fixed(setting.name) else 'yes'
    return f'`{setting.name}`', default, setting.shown_choices or setting.shown_range, changes, setting.help


def frames() -> str:
    """Returns the table of coordinate frames."""
    return table(('frame', 'parameter', ''), ((f.default, f'`{f.parameter}`', f.help) for f in interface.FRAMES))


def features() -> str:
    """Returns the table of features, with the tests that show them."""
    return table(('feature', 'level', 'shown by'), map(_feature, yaml.safe_load(FEATURES.read_text())))


def _feature(row: dict[str, Any]) -> Sequence[str]:
    return row['feature'], row['level'], _shown(row)


def faults() -> str:
    """Returns the table of faults and reactions, with the tests that show them."""
    rows = yaml.safe_load(FAULTS.read_text())
    return table(('fault', 'what happens', 'shown by'), ((row['fault'], row['happens'], _shown(row)) for row in rows))


def _shown(row: dict[str, Any]) -> str:
    shown = [f'`{test}`' for test in row.get('tests', ())]
    shown += [row['not_tested']] if 'not_tested' in row else []
    return '<br>'.join(shown)


def services() -> str:
    """Returns the table of services."""
    return table(('service', 'type', ''), ((f'`~/{service.name}`', service.type_name, service.help) for service in SERVICES))


def cameras() -> str:
    """Returns the table of cameras."""
    return table(
        ('`camera:=`', '', 'driver', 'colour, depth, camera info', ''),
        (
            (name, f'[{c.title}]({c.source})', f'`{c.driver}`', f'`{c.rgb}` `{c.depth}` `{c.info}`', c.facts)
            for name, c in CAMERAS.items()
        ),
    )


SECTIONS: dict[str, Callable[[], str]] = {
    'inputs': inputs,
    'outputs': outputs,
    'frames': frames,
    'parameters': parameters,
    'services': services,
    'cameras': cameras,
    'faults': faults,
    'features': features,
}


def generate(text: str) -> str:
    """Returns the page with new tables.

    Raises:
        ValueError: a section is unknown, or one is missing.
    """
    names = [match[2] for match in SECTION.finditer(text)]
    if sorted(names) != sorted(SECTIONS):
        raise ValueError(f'{PAGE.name} has the sections {names}; expected each of {list(SECTIONS)} once')
    return SECTION.sub(lambda match: f'{match[1]}{SECTIONS[match[2]]()}{match[3]}', text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page, or check it. Returns the exit code."""
    parser = argparse.ArgumentParser(description='Write the tables of docs/ros.md from the code.')
    parser.add_argument('--check', action='store_true', help='change nothing; exit with 1 if the tables are out of date')
    check = parser.parse_args(arguments).check
    before = PAGE.read_text()
    after = generate(before)
    if check:
        if before != after:
            print(f'{PAGE.relative_to(ROOT)} is out of date: run python tools/ros_reference.py', file=sys.stderr)
        return int(before != after)
    PAGE.write_text(after)
    return 0


if __name__ == '__main__':
    sys.exit(main())
