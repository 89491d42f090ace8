"""Commands with short help, and defaults from the `kcal.toml` of the folder."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand

from kcal.cli.console import err
from kcal.cli.settings import settings_text, taken


def rarely(metavar: str, about: str, *flags: str, panel: str | None = None, **more: Any) -> Any:
    """An option that few people need: `--help-all` shows it."""
    return typer.Option(*flags, metavar=metavar or None, help=about, hidden=True, rich_help_panel=panel, **more)


class Command(TyperCommand):
    """A command whose rare options are shown by `--help-all`, and that says what it took from kcal.toml."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.more = [param for param in self.params if getattr(param, "hidden", False)]
        if self.more:
            hint = f"`--help-all` shows {len(self.more)} more options."
            self.epilog = f"{self.epilog}\n\n{hint}" if self.epilog else hint

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Show all options and stop, if that was asked for."""
        if "--help-all" in args and self.more:
            shown, self.epilog = self.epilog, None
            try:
                for param in self.more:
                    param.hidden = False  # type: ignore[attr-defined]
                text = self.get_help(ctx)
            finally:
                for param in self.more:
                    param.hidden = True  # type: ignore[attr-defined]
                self.epilog = shown
            if text:
                print(text)
            ctx.exit()
        return super().parse_args(ctx, ["--help" if word == "--help-all" else word for word in args])

    def invoke(self, ctx: Any) -> Any:
        """Run the command; what it takes from kcal.toml is said first, in one line."""
        names = [
            param.name
            for param in self.params
            if getattr(ctx.get_parameter_source(param.name), "name", "") == "DEFAULT_MAP"
        ]
        taken.clear()
        taken.update(names)
        if names:
            err.print(settings_text({name: ctx.params[name] for name in names}), markup=False)
        return super().invoke(ctx)
