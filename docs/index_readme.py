"""The README as the package index shows it: relative links and pictures become addresses of `[project.urls]`.

Hatchling calls `CustomMetadataHook` when it builds a wheel or sdist.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class CustomMetadataHook(MetadataHookInterface):
    """Sets the field `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Put the README with absolute addresses into the metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = with_addresses(text, metadata["urls"]["Documentation"], metadata["urls"]["Source"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def with_addresses(text: str, site: str, source: str) -> str:
    """Return a text with links to pages of the site and to files of the source, in place of relative ones."""

    def absolute(match: re.Match[str]) -> str:
        path, anchor = match[1], match[2] or ""
        if not path.startswith("docs/"):
            return f"]({source}/blob/main/{path}{anchor})"
        page = re.sub(r"(^|/)index\.md$", r"\1", path.removeprefix("docs/"))
        page = re.sub(r"\.md$", "/", page)
        return f"]({site}{page}{anchor})"

    return re.sub(r"\]\(([\w./-]+)(#[\w-]+)?\)", absolute, text)
