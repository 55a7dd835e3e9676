"""`clsplat completion`: the script that completes commands and flags in a shell."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a script for completion of commands in a SHELL.

    For bash: `clsplat completion bash >> ~/.bashrc`; zsh: the same with ~/.zshrc; fish:
    `clsplat completion fish > ~/.config/fish/completions/clsplat.fish`.
    """
    completion_class = get_completion_class(shell)
    assert completion_class is not None  # click knows every shell of the choice
    command = ctx.find_root().command
    click.echo(completion_class(command, {}, "clsplat", "_CLSPLAT_COMPLETE").source())
