"""Commands that have subcommands and do their main work without one."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup


def group_with_default(command: str) -> type[TyperGroup]:
    """A group whose arguments go to `command` unless they begin with the name of another one."""

    class DefaultGroup(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            if not args or args[0] not in self.commands:
                args = [command, *args]
            return super().parse_args(ctx, args)

    return DefaultGroup
