"""The parameters of the command line, made from the signature of a command and its classes of options."""

import inspect
from collections.abc import Callable
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer

from stereophd.cli.options import CommonWords
from stereophd.cli.terminal import begin, stages_shown
from stereophd.options import Declaration


def command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that typer turns into a command.

    The first parameter of the given function is the `Session`. One whose type is a dataclass becomes the fields of that
    class, and the function is given an object of it; the others are annotated as typer wants it.
    """
    hints = get_type_hints(function, include_extras=True)
    _, *others = inspect.signature(function).parameters.values()
    shown = {"context": inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)}
    classes: dict[str, type[Any]] = {}
    for parameter in others:
        kind = hints[parameter.name]
        if is_dataclass(kind):
            assert isinstance(kind, type)
            classes[parameter.name] = kind
            shown |= _of_class(kind)
        else:
            shown[parameter.name] = parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY)
    common = _of_class(CommonWords)
    shown |= common

    def run(**values: Any) -> Any:
        session = begin(values.pop("context"), **{name: values.pop(name) for name in common})
        for name, kind in classes.items():
            values[name] = kind(**{each.name: _parsed(each, values.pop(each.name)) for each in _stated(kind)})
        with stages_shown(session):
            return function(session, **values)

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature(list(shown.values()))  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in shown.items()}
    return run


def _of_class(kind: type[Any]) -> dict[str, inspect.Parameter]:
    """Return the parameters of the fields of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return {each.name: _parameter(each, hints[each.name]) for each in _stated(kind)}


def _stated(kind: type[Any]) -> list[Field[Any]]:
    """Return the fields of a class that the command line states: of a class of options those that are declared."""
    declared = [each for each in fields(kind) if "option" in each.metadata]
    return declared or list(fields(kind))


def _parameter(each: Field[Any], hint: Any) -> inspect.Parameter:
    default = inspect.Parameter.empty if each.default is MISSING else each.default
    default = default if each.default_factory is MISSING else None
    declared: Declaration | None = each.metadata.get("option")
    if declared is not None:
        hint = Annotated[_shell_type(hint, declared), _typer_option(each.name, hint, declared, default)]
    return inspect.Parameter(each.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _shell_type(hint: Any, declared: Declaration) -> Any:
    """Return the type that typer parses: words where the option has a parser, paths instead of texts."""
    if declared.parse is not None:
        return list[str] | None
    if get_origin(hint) in (Union, UnionType) and Path in get_args(hint):
        return Path | None
    return hint


def _typer_option(name: str, hint: Any, declared: Declaration, default: Any) -> Any:
    flag, is_flag = declared.flag_of(name), bool in (hint, *get_args(hint))
    words = f"{flag}/{flag.replace('--', '--no-', 1)}" if is_flag and default is not False else flag
    more: dict[str, Any] = {"metavar": declared.metavar} if declared.metavar else {}
    if type(None) in get_args(hint):
        more["show_default"] = False
    return typer.Option(words, help=declared.meaning, **more)


def _parsed(each: Field[Any], value: Any) -> Any:
    """Return the value of an option from what typer has parsed."""
    declared: Declaration | None = each.metadata.get("option")
    if declared is None or declared.parse is None:
        return value
    return declared.parse(declared.flag_of(each.name), value or ())
