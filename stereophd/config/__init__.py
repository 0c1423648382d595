"""Configuration: YAML files to validated models to domain objects, with messages that name the place."""
