"""A hook of MkDocs: makes README.md and CONTRIBUTING.md pages of the documentation site.

The two files stay where GitHub and ROS expect them. Here their links are rewritten from the repository's root to the docs
folder, so that ``mkdocs build --strict`` checks them like all others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {'README.md': 'index.md', 'CONTRIBUTING.md': 'contributing.md'}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=_from_root((ROOT / source).read_text())))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Point links from docs pages to the root's files at the pages made of them."""
    depth = page.file.src_uri.count('/')
    for source, target in PAGES.items():
        markdown = markdown.replace(f']({"../" * (depth + 1)}{source}', f']({"../" * depth}{target}')
    return markdown


def _from_root(markdown: str) -> str:
    for source, page in PAGES.items():
        markdown = markdown.replace(f']({source}', f']({page}')
    return markdown.replace('](docs/', '](')
