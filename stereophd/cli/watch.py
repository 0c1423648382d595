"""``stereophd watch``."""

from typing import Annotated

import typer

from stereophd.cli import options

Address = Annotated[str, options.argument("ADDRESS", "Where `track --publish` sends, such as tcp://127.0.0.1:5556.")]
Host = Annotated[str, typer.Option("--host", metavar="HOST", help="Whose browsers may open the page.")]
Port = Annotated[int, typer.Option("--port", metavar="N", min=0, max=65535, help="Port of the page; 0: any.")]


def watch_command(session: options.Session, address: Address, host: Host = "127.0.0.1", port: Port = 0) -> None:
    """Show a live run in a browser: cameras, tracks with tails, residuals, delay, frames that were too late.

    The address of the page is printed. It holds a token: nobody else can open the page. Ctrl-C ends it.
    """
    from stereophd.commands.watch import Watch

    watch = Watch(address, host, port)
    typer.echo(watch.url)
    try:
        watch.run()
    finally:
        watch.close()
