"""How an option of a command is declared, once: a field of a class of options, with its meaning, default and use::

    @options
    class TrackOptions:
        \"\"\"Options of `track`.\"\"\"

        threads: int = option("threads; the outputs do not depend on it", default=1, metavar="N", least=1)

`stereophd.cli.parameters` makes the parameters of the command line and their help from the class, and
`stereophd.cli.flags` the options in messages. In Python a function that `takes` the class is given an object of it, or
its fields by name, and its docstring lists them. A field without `option` is no option of the command line. What is
declared is checked when an object is made. Nothing heavy may be imported here: the help must be quick.
"""

import inspect
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import wraps
from numbers import Integral, Real
from typing import Any, Literal, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

from stereophd.errors import InputError, nearest

Class = TypeVar("Class")
Result = TypeVar("Result")
Parser = Callable[[str, Sequence[str]], Any]


@dataclass(frozen=True)
class Declaration:
    """What the declaration of an option states besides its name, type and default."""

    meaning: str
    metavar: str  # word for the value in the help, with its unit
    flag: str  # name of the option on the command line; "": that of the field
    least: float | None
    above: float | None  # a number below the least value, which is none itself
    parse: Parser | None  # flag, words -> value: the option is repeatable
    use: str  # "": the option acts in every use of its command; else the only use in which it acts

    def flag_of(self, name: str) -> str:
        """Return the option of the command line for the field of this name."""
        return "--" + (self.flag or name.replace("_", "-"))


def option(
    meaning: str, *, default: Any = MISSING, default_factory: Any = MISSING, metavar: str = "", flag: str = "",
    least: float | None = None, above: float | None = None, parse: Parser | None = None, use: str = "",
) -> Any:  # fmt: skip
    """Declare a field of `options`; the parameters are those of `Declaration`, and its default."""
    declared = Declaration(meaning, metavar, flag, least, above, parse, use)
    return field(default=default, default_factory=default_factory, metadata={"option": declared})


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(option,))
def options(cls: type[Class]) -> type[Class]:
    """Make a class of options: a frozen dataclass whose fields are given by name, and are checked.

    An object raises InputError for a number that is not finite or out of range, and a word that is no choice.
    """
    complete = vars(cls).get("__post_init__", lambda made: None)

    def check(made: Any) -> None:
        complete(made)
        hints = get_type_hints(type(made))
        for name, declared in declarations(type(made)).items():
            # by `vars`, because options that note what a format reads must not note this
            if (expected := _expected(vars(made)[name], hints[name], declared)) is not None:
                found = str(vars(made)[name]).removesuffix(".0")
                raise InputError(f"`{name}`: expected {expected}, found {found}")

    cls.__post_init__ = check  # type: ignore[attr-defined]
    return dataclass(frozen=True, kw_only=True)(cls)


def _expected(value: Any, hint: Any, declared: Declaration) -> str | None:
    """Return what an option expected where its value is none of that; None of one that may be."""
    if isinstance(value, Real):  # numbers of NumPy, too
        value = int(value) if isinstance(value, Integral) else float(value)
        if not -math.inf < value < math.inf:
            return "a finite number"
        if declared.above is not None and value <= declared.above:
            return f"a number above {declared.above:g}"
        return f"at least {declared.least:g}" if declared.least is not None and value < declared.least else None
    kinds = [hint] if get_origin(hint) is Literal else [kind for kind in get_args(hint) if kind is not type(None)]
    if len(kinds) != 1 or get_origin(kinds[0]) is not Literal or value is None or value in get_args(kinds[0]):
        return None
    choices = get_args(kinds[0])
    return " or ".join(choices) if len(choices) == 2 else f"one of {', '.join(choices)}"


def declarations(kind: type) -> dict[str, Declaration]:
    """Return the declarations of a class of options by the names of the fields."""
    return {each.name: each.metadata["option"] for each in fields(kind) if "option" in each.metadata}


def names_of_use(kind: type, use: str) -> list[str]:
    """Return the names of the options of a class that act only in this use."""
    return [name for name, declared in declarations(kind).items() if declared.use == use]


def takes(kind: type[Any]) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Let a function with a parameter `options` of this class also take the fields by name.

    The signature and the docstring of the function list them.
    """
    names = [each.name for each in fields(kind)]

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        plain = inspect.signature(function)

        @wraps(function)
        def call(*arguments: Any, options: Any = None, **words: Any) -> Result:
            known = [*(name for name in plain.parameters if name != "options"), *names]
            if unknown := [name for name in words if name not in known]:
                raise InputError(f"`{unknown[0]}`: unknown argument{nearest(unknown[0], known)}")
            stated = {name: words.pop(name) for name in names if name in words}
            chosen = kind(**stated) if options is None else replace(options, **stated)
            return function(*arguments, options=chosen, **words)

        own = [parameter for parameter in plain.parameters.values() if parameter.name != "options"]
        by_name = [
            inspect.Parameter(each.name, inspect.Parameter.KEYWORD_ONLY, default=_default(each), annotation=each.type)
            for each in fields(kind)
        ]
        call.__signature__ = plain.replace(parameters=[*own, *by_name])  # type: ignore[attr-defined]
        before, heading, after = (function.__doc__ or "").partition("\n    Returns\n")
        title = "" if "    Parameters\n" in before else "\n    Parameters\n    ----------\n"
        call.__doc__ = f"{before.rstrip()}\n{title}{_listed(kind)}\n{heading}{after}"
        return call

    return decorate


def _listed(kind: type[Any]) -> str:
    """Return the options of a class as a docstring lists parameters."""
    lines = []
    for each in fields(kind):
        declared: Declaration | None = each.metadata.get("option")
        meaning = f"see `{kind.__name__}`" if declared is None else declared.meaning
        text = textwrap.indent(textwrap.fill(f"{meaning} (default {_default(each)})", 104), " " * 8)
        lines += [f"    {each.name} : {each.type}", text]
    return "\n".join(lines)


def _default(each: Field[Any]) -> Any:
    return each.default if each.default_factory is MISSING else each.default_factory()


def numbers_by_key(flag: str, words: Sequence[str]) -> dict[str, float]:
    """Return {key: number} of the words KEY=VALUE of an option; InputError for another form or a repeated key."""
    numbers: dict[str, float] = {}
    for word in words:
        key, separator, value = word.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not key or not separator or not math.isfinite(number):
            raise InputError(f"{flag} {word}: expected KEY=NUMBER, such as ospa.mean=0.8")
        if key in numbers:
            raise InputError(f"{flag} {word}: expected each key once, found {key} again")
        numbers[key] = number
    return numbers
