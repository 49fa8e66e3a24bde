"""A hook of MkDocs: pages of the documentation site that are not files in docs/.

README.md and CONTRIBUTING.md stay where GitHub and ROS expect them. Here their links are rewritten from the repository's root
to the docs folder, so that ``mkdocs build --strict`` checks them like all others. The table of settings comes from
``splatam_core.config``, which imports neither torch nor ROS.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {'README.md': 'index.md', 'CONTRIBUTING.md': 'contributing.md'}
SETTINGS = 'settings.md'
SETTINGS_HEAD = """# All settings

Change a setting with `--set NAME=VALUE` on the command line, or as the ROS parameter `slam.NAME`. [Presets](presets.md) change
several at once. The defaults are the paper's for Replica.
"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=_from_root((ROOT / source).read_text())))
    files.append(File.generated(config, SETTINGS, content=settings_page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Points links to the root's files at the pages made of them."""
    depth = page.file.src_uri.count('/')
    for source, target in PAGES.items():
        markdown = markdown.replace(f']({"../" * (depth + 1)}{source}', f']({"../" * depth}{target}')
    return markdown


def settings_page() -> str:
    """Returns a table of every SLAM setting, a section each."""
    sys.path.insert(0, str(ROOT))
    from splatam_core.config import settings

    lines, section = [SETTINGS_HEAD], None
    for setting in settings():
        path, _, name = setting.name.rpartition('.')
        if path != section:
            section = path
            lines += ['', f'## {path or "General"}', '', '| setting | default | allowed | what it does |', '|---|---|---|---|']
        allowed = setting.shown_choices or setting.shown_range
        lines.append(f'| `{name}` | `{setting.shown_default}` | {allowed} | {setting.help} |')
    return '\n'.join(lines) + '\n'


def _from_root(markdown: str) -> str:
    for source, page in PAGES.items():
        markdown = markdown.replace(f']({source}', f']({page}')
    return markdown.replace('](docs/', '](')
