"""Addresses of the documentation, for messages: a reader may have no source tree."""

# Also `[project.urls]` of pyproject.toml and `site_url` of mkdocs.yml; a test compares them.
SITE = "https://stereophd.github.io/stereophd/"


def page(name: str) -> str:
    """Return the address of a page of the documentation by its place in ``docs/``, such as ``reference/formats``."""
    return f"{SITE}{name}/"
