"""Commands from plain functions: options from annotations and defaults, their help from the docstring's `Args:`.

    def show_command(file: RigFile, *, pitch: Rare[Degrees] = 0.0, output: Output | None = None) -> None:

Parameters before the `*` are arguments, those after it are options. A `Kind` in the annotation tells the metavar, how
the text is read, and the flags if they are not the parameter's name. A parameter whose type is a dataclass stands for
the options that are its fields. One whose type is a dictionary may be repeated, for another name each time.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import functools
import inspect
import itertools
import os
import re
import shlex
import sys
import tomllib
import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin

import orjson
import typer
from typer.core import TyperCommand, TyperGroup

from kcal import values
from kcal.cli import console
from kcal.cli.inputs import Wanted, check_given, given_files, given_texts
from kcal.errors import FileError, InputError
from kcal.files import check_writable, is_stream, read_bytes, write_atomic

# Settings of a folder: `kcal.toml` gives options of the commands that are run there or below.

NAME = "kcal.toml"
_MOST_BYTES = 2**20
# Parameters of the running command that the file gave.
taken: set[str] = set()


class Setting(NamedTuple):
    """One key: its type, an example, and what reads its text. Options of its name whose `Kind` says so take it."""

    kind: type
    example: str
    read: Callable[[str, str], Any] | None = None


SETTINGS = {
    "board": Setting(str, '"9x6"'),
    "square": Setting(str, '"25mm"', values.length),
    "source": Setting(str, '"camera:0"'),
    "site": Setting(str, '"19.07,72.87,14"', values.place_on_earth),
    "heading": Setting(float, "35.0"),
    "pixel_sigma": Setting(float, "0.3"),
    "require": Setting(str, '"5km:10%"', values.ranges_and_errors),
    "baseline": Setting(float, "10.0"),
}


def settings_file(folder: str | Path = ".") -> Path:
    """The nearest kcal.toml: that of the folder or of one that it lies in, up to the root of its file system.

    Where there is none, it is the one that `kcal init` would write.
    """
    shown = Path(folder)
    with suppress(OSError):  # where the folder itself was removed meanwhile
        for place in (shown.resolve(), *shown.resolve().parents):
            if os.path.isfile(shown / NAME):
                return shown / NAME
            if os.path.ismount(place):
                break
            shown /= ".."
    return Path(folder, NAME)


def read_settings(folder: str | Path = ".") -> dict[str, Any]:
    """The settings of a folder by name; none if neither it nor a folder that it lies in has a kcal.toml.

    Raises:
        FileError: not TOML, an unknown key, or a value of another type.
    """
    path = settings_file(folder)
    if not path.is_file():
        return {}
    try:
        content = tomllib.loads(read_bytes(path, _MOST_BYTES).decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        again = shlex.join(["kcal", "init", *([] if path.parent == Path() else [str(path.parent)]), "--force"])
        raise FileError(f"{path}: not TOML: {error}. To write a new one: {again}") from error
    found = {key: checked_setting(key, value, path) for key, value in content.items()}
    if not is_stream(found.get("source", "camera:0")):  # a folder of images, which is named from where the file is
        found["source"] = os.path.join(os.path.relpath(path.parent, folder), found["source"]).removeprefix("./")
    return found


def checked_setting(key: str, value: Any, path: Path) -> Any:
    """A value as a key of the file has it.

    Raises:
        FileError: an unknown key, or a value of another type.
    """
    if key not in SETTINGS:
        near = difflib.get_close_matches(key, SETTINGS, 1, 0.0)[0]
        raise FileError(f"{path}: unknown key {key[:40]!r}; did you mean {near}? Known are {', '.join(SETTINGS)}")
    wanted = SETTINGS[key].kind
    # An integer of TOML may be larger than any float.
    number = wanted is float and type(value) in (int, float) and abs(value) <= sys.float_info.max
    if not number and (wanted is float or not isinstance(value, str)):
        what = "a number" if wanted is float else "a text in quotation marks"
        raise FileError(f"{path}: {key} must be {what}, for example {key} = {SETTINGS[key].example}")
    if (read := SETTINGS[key].read) is not None:
        try:
            read(value, key)
        except InputError as error:
            raise FileError(f"{path}: {error}") from None
    return wanted(value)


def defaults_of(settings: dict[str, Any], command: Any) -> dict[str, Any]:
    """Defaults of a command's parameters, and of its subcommands by their names, as the command line takes them."""
    if not hasattr(command, "commands"):
        return {key: settings[key] for key in getattr(command.callback, "settings", set()) & settings.keys()}
    own = {name: defaults_of(settings, one) for name, one in command.commands.items()}
    return {name: defaults for name, defaults in own.items() if defaults}


def settings_text(found: dict[str, Any], path: Path) -> str:
    """What was taken from the file, in one line.

    Example:
        >>> settings_text({"board": "9x6", "pixel_sigma": 0.1}, Path("../kcal.toml"))
        'from ../kcal.toml: board 9x6, pixel_sigma 0.1'
    """
    return f"from {path}: {', '.join(f'{name} {value}' for name, value in found.items())}"


# Options, and what reads them.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """How an option is typed.

    Args:
        metavar: what stands for the value in the help.
        read: makes the value of the text, and is told the option's name; None: the annotation's type does.
        early: whether the text is read before it is known whether others are missing.
        usage: whether a text that cannot be read is wrong usage, exit code 2, as a word for a number is.
        least: the smallest number allowed.
        flags: of the option, where they are not its name.
        several: whether all words up to the next option are values of this one, as in `--stars a.png b.png`.
        rare: whether only `--help-all` shows it.
        setting: whether kcal.toml may give it.
        writes: whether it names a file to write: that is refused at once where it cannot be written, or is a file that
            another option names.
        of: name of the option without which this one does nothing, which is said.
        panel: title of the box in the help.
        about: what it is; `{}` stands for what `Args:` say of the one option.
    """

    metavar: str | None = None
    read: Callable[[str, str], Any] | None = None
    early: bool = False
    usage: bool = False
    least: float | None = None
    flags: tuple[str, ...] = ()
    several: bool = False
    rare: bool = False
    setting: bool = False
    writes: bool = False
    of: str = ""
    panel: str | None = None
    about: str = "{}"


@dataclasses.dataclass(frozen=True)
class Only:
    """Fields of a dataclass that are options; the others keep their defaults."""

    names: tuple[str, ...]


_T = TypeVar("_T")
Rare = Annotated[_T, Kind(rare=True)]
Several = Annotated[list[_T], Kind(several=True)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Option:
    """A parameter of the command line, taken apart."""

    name: str
    type: Any
    kind: Kind
    wanted: Wanted | None
    default: Any
    about: str
    argument: bool
    group: str | None

    @property
    def label(self) -> str:
        """What it is called in messages."""
        if self.argument:
            return _words(self.name).upper()
        return next((flag for flag in self.kind.flags if flag.startswith("--")), f"--{_words(self.name)}")

    @property
    def parameter(self) -> inspect.Parameter:
        """As typer takes it."""
        text, default = self.type, self.default
        if self.kind.read is not None:
            text, default = _of_text(text), default if default in (None, inspect.Parameter.empty) else str(default)
        shared: dict[str, Any] = {"help": self.about.replace("[", r"\[")}
        shared |= {"min": self.kind.least, "rich_help_panel": self.kind.panel, "show_default": bool(str(default))}
        if self.kind.early:
            shared["callback"] = self._checked
        if self.argument:
            info: Any = typer.Argument(**shared)
        else:
            only = self.type is bool and self.default is False
            flags = self.kind.flags or ((self.label,) if only or self.name != _words(self.name) else ())
            info = typer.Option(*flags, hidden=self.kind.rare, metavar=self.kind.metavar, **shared)
        return _keyword(self.name, default, Annotated[text, info])

    def value(self, given: Any) -> Any:
        """What the command gets."""
        if given != given:
            raise InputError(f"{self.label}: a number is needed, not nan")
        if self.kind.read is None or given is None:
            return given
        if not isinstance(given, list | tuple):
            return self._read(str(given))
        read = type(given)(map(self._read, given))
        if dict not in [get_origin(one) for one in (self.type, *get_args(self.type))]:
            return read
        names = [name for name, _ in read]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{self.label}: {twice[0]} is stated twice")
        return dict(read)

    def _checked(self, text: str | None) -> str | None:
        if text is not None:
            self._read(text)
        return text

    def _read(self, text: str) -> Any:
        assert self.kind.read is not None
        try:
            return self.kind.read(text, self.label)
        except InputError as error:
            if self.kind.usage:
                raise typer.BadParameter(str(error)) from None
            raise


def _keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _words(name: str) -> str:
    return name.strip("_").replace("_", "-")


def _taken_apart(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    """The plain type, and what `Annotated` says of it or of its parts."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        inner, more = _taken_apart(parts[0])
        return inner, (*more, *parts[1:])
    if origin in (Union, types.UnionType, list, tuple, dict):
        apart = [_taken_apart(part) for part in parts]
        metadata = tuple(dict.fromkeys(one for _, more in apart for one in more))
        plain = tuple(inner for inner, _ in apart)
        return (Union[plain] if origin in (Union, types.UnionType) else origin[plain]), metadata  # noqa: UP007
    return annotation, ()


def _of_text(plain: Any) -> Any:
    """The same type with texts in it, before these are read."""
    if plain is types.NoneType:
        return plain
    origin, parts = get_origin(plain), tuple(map(_of_text, get_args(plain)))
    if origin in (Union, types.UnionType):
        return Union[parts]  # noqa: UP007
    return list[str] if origin in (list, dict) else str


def described(docstring: str | None) -> tuple[str, dict[str, str]]:
    """A docstring without its `Args:`, and what these say of each name.

    Example:
        >>> described("Show a file.\\n\\nArgs:\\n    file: Camera file,\\n        or rig file.\\n\\nMore.")
        ('Show a file.\\n\\nMore.', {'file': 'Camera file, or rig file.'})
    """
    text = inspect.cleandoc(docstring or "")
    found = re.search(r"^Args:\n((?:    .*\n|\n)*)", f"{text}\n", re.MULTILINE)
    if found is None:
        return text, {}
    names = re.findall(r"^    (\w+): ((?:.*\n(?:     .*\n)*))", found.group(1), re.MULTILINE)
    rest = f"{text[: found.start()].rstrip()}\n\n{text[found.end() :].strip()}".strip()
    return rest, {name: " ".join(about.split()) for name, about in names}


def _declared_options(
    parameters: Sequence[inspect.Parameter], about: dict[str, str], group: str | None = None
) -> Iterator[_Option]:
    for each in parameters:
        plain, more = _taken_apart(each.annotation)
        if dataclasses.is_dataclass(plain) and group is None:
            only = next((one.names for one in more if isinstance(one, Only)), None)
            every = inspect.signature(plain, eval_str=True).parameters  # type: ignore[arg-type]
            fields = [field for field in every.values() if only is None or field.name in only]
            yield from _declared_options(fields, about | described(plain.__doc__)[1], each.name)
            continue
        kinds = [one for one in more if isinstance(one, Kind)]
        told = {name: value for one in kinds for name, value in vars(one).items() if value != getattr(Kind, name)}
        kind = Kind(**told)
        yield _Option(
            name=each.name, type=plain, kind=kind, group=group,
            about=kind.about.format(about[each.name]) if "{}" in kind.about else kind.about,
            wanted=next((one for one in more if isinstance(one, Wanted)), None),
            default=each.default,
            argument=each.kind is not each.KEYWORD_ONLY,
        )  # fmt: skip


def declared(function: Callable[..., None], *, json: bool = True) -> Callable[..., None]:
    """The function as typer takes it: files are checked first, then values are read, then it is called.

    Args:
        function: a command, see above.
        json: whether it has an option `--json`: one JSON object on the standard output, in place of what it prints.
            It has `exit_code`, what the command tells (`console.tell`), the lines that a person would read as `text`,
            and `error` if the command failed. The error stream and the exit code are the same, with it and without.
    """
    signature = inspect.signature(function, eval_str=True)
    text, about = described(function.__doc__)
    options = list(_declared_options([*signature.parameters.values()], about))
    labels = {one.name: one.label for one in options}
    names = [name for name in signature.parameters if name in {one.group for one in options}]
    groups = {name: _taken_apart(signature.parameters[name].annotation)[0] for name in names}

    def work(given: dict[str, Any]) -> None:
        others = [path for one in options if not one.kind.writes for path in given_files(given[one.name])]
        for path in (path for one in options if one.kind.writes for path in given_texts(given[one.name])):
            if path != "-":
                check_writable(path, *others)
        for one in options:
            idle = one.kind.of and not given[one.kind.of] and one.name not in taken
            if idle and given[one.name] not in (None, [], one.parameter.default):
                console.warn(f"{one.label} does nothing without {labels[one.kind.of]}")
        check_given([(one.label, one.wanted, given[one.name]) for one in options if one.wanted is not None])
        read: dict[str | None, dict[str, Any]] = {None: {}, **{name: {} for name in groups}}
        for one in options:
            read[one.group][one.name] = one.value(given[one.name])
        own = read[None] | {name: cls(**read[name]) for name, cls in groups.items()}
        bound = signature.bind_partial()
        bound.arguments.update({name: own[name] for name in signature.parameters})
        function(*bound.args, **bound.kwargs)

    @functools.wraps(function)
    def run(*, as_json: bool = False, **given: Any) -> None:
        console.told.clear()
        if not as_json:
            return work(given)
        ended: Exception = typer.Exit(0)
        with console.out.capture() as captured:
            try:
                work(given)
            except (typer.Exit, *console.ERRORS) as stopped:
                ended = stopped
        told = {"exit_code": getattr(ended, "exit_code", 1), **console.told, "text": captured.get().splitlines()}
        if not isinstance(ended, typer.Exit):
            told["error"] = console.error_text(ended)
        console.end_line()
        print(orjson.dumps(told).decode())
        raise ended

    parameters = [one.parameter for one in options]
    if json:
        option = Annotated[bool, typer.Option("--json", help="Print one JSON object for programs in place of text.")]
        parameters.append(_keyword("as_json", False, option))
    run.__doc__ = text
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.several = {one.name for one in options if one.kind.several}  # type: ignore[attr-defined]
    run.settings = {one.name for one in options if one.kind.setting}  # type: ignore[attr-defined]
    return run


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
            whole = copy.deepcopy(self)
            whole.epilog = None
            for param in whole.more:
                param.hidden = False  # type: ignore[attr-defined]
            if text := whole.get_help(ctx):
                print(text)
            ctx.exit()
        words = ["--help" if word == "--help-all" else word for word in args]
        return super().parse_args(ctx, self._spread(words))

    def _spread(self, words: list[str]) -> list[str]:
        """Each value of an option that takes several with the flag before it, as typer wants them.

        The values end at the next option. Words that arguments of the command still need are the last of them.
        """
        several: set[str] = getattr(self.callback, "several", set())
        takes = {flag: param for param in self.params for flag in (*param.opts, *param.secondary_opts)}
        spread: list[list[str]] = []
        alone, i = 0, 0
        while i < len(words):
            flag, equals, _ = words[i].partition("=")
            param = takes.get(flag) if flag.startswith("-") else None
            if words[i] == "--":
                alone += len(words) - i - 1
                spread.append(words[i:])
                break
            count = 0 if param is None or equals or getattr(param, "is_flag", False) else param.nargs
            if param is not None and param.name in several and not equals:
                count = len([*itertools.takewhile(lambda word: not re.match(r"-(?![.\d])", word), words[i + 1 :])])
            alone += not words[i].startswith("-")
            spread.append(words[i : i + 1 + count])
            i += 1 + count
        needed = (param.nargs for param in self.params if param.required and not param.opts[0].startswith("-"))
        missing = sum(needed) - alone
        found: list[str] = []
        for group in reversed(spread):
            param = takes.get(group[0])
            if param is None or param.name not in several or len(group) < 2 or "=" in group[0]:
                found = [*group, *found]
                continue
            back = max(0, min(missing, len(group) - 2))
            missing -= back
            values = group[1 : len(group) - back]
            found = [*(word for value in values for word in (group[0], value)), *group[len(group) - back :], *found]
        return found

    def invoke(self, ctx: Any) -> Any:
        """Run the command; what it takes from kcal.toml is said first, in one line."""
        sources = {param.name: ctx.get_parameter_source(param.name) for param in self.params}
        names = [name for name, source in sources.items() if getattr(source, "name", "") == "DEFAULT_MAP"]
        taken.clear()
        taken.update(names)
        if names:
            console.err.print(settings_text({name: ctx.params[name] for name in names}, settings_file()))
        return super().invoke(ctx)


def group_with_default(command: str) -> type[TyperGroup]:
    """A group whose arguments go to `command` unless they begin with the name of another one."""

    class DefaultGroup(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            if not args or args[0] not in self.commands:
                args = [command, *args]
            return super().parse_args(ctx, args)

    return DefaultGroup


# `kcal init`: a kcal.toml for a folder, so that the commands that are run there are short.


def init_command(folder: Path = Path("."), *, force: bool = False, **given: Any) -> None:
    """Write a kcal.toml: board, camera and site, which the commands that are run in this folder or below then know.

    What is typed on a command line goes before what the file says, and each command says in one line what it took from
    it. A folder's own file replaces that of a folder above. Without options all lines are comments, to be filled in by
    hand.

    **Examples**

    `kcal init --board 9x6 --square 25mm --site 19.07,72.87,14 --pixel-sigma 0.1`

    `kcal detect left/ -o left.obs.json`

    Args:
        folder: Folder of the images.
        force: Write anew a file that is there.
        board: Pattern, as for kcal detect --board
        square: Side of a square, with its unit
        source: Where kcal capture gets images: a device, a stream or a folder
        site: Where the left camera stands: latitude, longitude, height above WGS84, where the rig's file does not say
        heading: Azimuth of the left camera's axis there, degrees
        pixel_sigma: Noise of marks along each axis, pixels
        require: Ranges, and the largest σ of each
        baseline: Distance between the cameras, meters
    """
    path = folder / NAME
    if path.exists() and not force:
        raise FileError(f"{path}: is there already; edit it, or write it anew: kcal init --force")
    if not any(value is not None for value in given.values()) and not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    for key, value in given.items():
        if value is not None:
            checked_setting(key, value, path)
    check_writable(path)
    write_atomic(path, toml_text(given))
    read_settings(folder)
    console.print_wrote(path)


def _with_settings() -> inspect.Signature:
    """That of the command with an option for each key of the file."""
    parameters = [*inspect.signature(init_command, eval_str=True).parameters.values()][:-1]
    for key, setting in SETTINGS.items():
        kind: Any = setting.kind
        annotation = Annotated[kind | None, Kind(metavar="VALUE", about=f"{{}}, for example {setting.example}.")]
        parameters.append(_keyword(key, None, annotation))
    return inspect.Signature(parameters)


init_command.__signature__ = _with_settings()  # type: ignore[attr-defined]


def toml_text(given: dict[str, Any]) -> str:
    """A kcal.toml with these settings; all others stand in it as comments."""
    lines = ["# Options of kcal's commands in this folder and those below; what is typed goes first.", ""]
    about = described(init_command.__doc__)[1]
    for key, setting in SETTINGS.items():
        value = given.get(key)
        lines.append(f"# {about[key]}.")
        lines.append(f"# {key} = {setting.example}" if value is None else f"{key} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if not isinstance(value, str):
        return repr(float(value))
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
