"""Documents that several foreign formats share: OpenCV's storage, TOML, tables of text."""
