"""`clsplat completion`: the script that completes commands and flags in a shell."""

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
@click.pass_context
def completion(ctx, shell):
    """Print the completion script of a SHELL.

    For bash: `clsplat completion bash >> ~/.bashrc`; zsh: the same with ~/.zshrc; fish:
    `clsplat completion fish > ~/.config/fish/completions/clsplat.fish`.
    """
    script = get_completion_class(shell)(ctx.find_root().command, {}, "clsplat",
                                         "_CLSPLAT_COMPLETE")
    click.echo(script.source())
