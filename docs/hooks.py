"""A hook of MkDocs: links from the manual to source files lead to copies of them in the built site.

In the repository such a link is relative, `../player/render.py`, and works where the files are looked at. A
site holds only what lies in `docs/`, so that the files that are linked to are added to it as they are.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

REPOSITORY = Path(__file__).resolve().parent.parent
LINK = re.compile(
    r"\]\((?:\.\./)+((?:player|exporters|vfr_bake|examples|tests)/[^)#\s]+|[A-Z]\w*(?:\.md)?)\)"
)


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    """Point links that lead out of `docs/` to copies inside the site."""
    up = "../" * page.file.src_uri.count("/")

    def link(found: re.Match[str]) -> str:
        uri = f"source/{found[1]}.txt"
        if files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, content=(REPOSITORY / found[1]).read_bytes()))
        return f"]({up}{uri})"

    return LINK.sub(link, markdown)
