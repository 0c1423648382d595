"""Options that would do nothing in the use that is made of a command: refused, or only reported.

What the contract of the command line demands that a command accepts in every use is reported, such as ``--force``,
``--seed`` or ``track --jobs`` for one log: the outputs do not depend on it. Everything else is refused.

These warnings are about the command line. They are no findings about the data, so that ``--strict`` does not act on
them.
"""

from collections.abc import Sequence

from stereophd.cli.options import Session
from stereophd.errors import InputError
from stereophd.wording import LOGGER


def refuse(session: Session, names: Sequence[str], use: str) -> None:
    """Refuse parameters of a command, by name, that the user states, and that act only in another use.

    `use` continues the sentence "--option: expected only ...", such as "with --out DIR, found none". Raises InputError
    if one of them is on the command line.
    """
    for option in _stated(session, names):
        raise InputError(f"{option}: expected only {use}")


def report(session: Session, names: Sequence[str], use: str) -> None:
    """Warn of parameters that the user states, and that act only in another use; otherwise the same as `refuse`."""
    for option in _stated(session, names):
        LOGGER.warning("%s does nothing here: it acts only %s", option, use)


def report_jobs_beside_dask(session: Session, dask: str | None) -> None:
    """Warn of a stated --jobs where a cluster does the work."""
    if dask is not None:
        report(session, ("jobs",), "without --dask, whose cluster does the work")


def _stated(session: Session, names: Sequence[str]) -> list[str]:
    """Return the options of the parameters that are on the command line."""
    context, out = session.context, []
    assert context is not None
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is not None and source.name == "COMMANDLINE":
            out.append(parameter.opts[0])
    return out
