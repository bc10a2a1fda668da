"""The console scripts. Nothing heavy is imported before Hydra has understood the command line."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

from hudepth.base.errors import ConfigError, closest, did_you_mean
from hudepth.base.options import plain
from hudepth.base.verbs import OWN_COMMAND, SUBCOMMANDS, commands, conf_folder, module_of, options_of
from hudepth.base.wording import LAUNCHERS, known_keys, one_line

ADDED_GROUPS = ("experiment", "sweep")
"""Groups that are no part of the defaults: ``experiment=x`` is turned into the ``+experiment=x`` that Hydra wants."""

PATHS = {
    "input", "output", "checkpoint", "resume", "init", "run", "runs", "dir", "a", "b", "name", "images", "sweep_dir",
    "model.weights", "distill.teacher", "distill.pictures", "data.root", "data.cache", "data.source.images",
    "data.source.depths", "data.source.manifest", "data.source.train_list", "data.source.test_list",
    "paths.runs", "paths.sweeps", "paths.cache", "camera", "predictions", "data.source.camera",
}  # fmt: skip
"""Options that are paths, names or a camera (``fov=62``): text, whatever Hydra's grammar would make of it."""

_WORD = re.compile(r"(?!(null|true|false|nan|inf)$)[A-Za-z_][\w./-]{0,99}", re.IGNORECASE)
"""A choice of a group: nothing that Hydra reads as a number or a constant."""


_VERBLESS = ("verb=", "-sc", "--shell_completion")
"""What needs no verb, or has one."""
_LOOKS = ("--cfg", "-c", "--info", "-i", "--hydra-help")
"""Flags with which nothing is done but printing, so that a verb may be missing."""
_SUBJECT = {"predict": "input", **dict.fromkeys(("test", "export", "bench", "demo"), "checkpoint")}
"""What a word without ``key=`` is probably meant for."""


def _script(task: str) -> int:
    """Run one task; whoever reads its output may leave early, as ``head`` does."""
    try:
        code = _main(task)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
        return 141  # as of a program that SIGPIPE ended
    return code


def _main(task: str) -> int:
    """Run one task with the arguments of this process; return its exit code."""
    # Threads that wait for each other soon sleep. By default they spin for milliseconds, and prediction beside another
    # busy program drops to a tenth (experiments/speed/busy_machine.py). OpenMP reads this when torch is imported.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    arguments = sys.argv[1:]
    if any(argument in ("-h", "--help") for argument in arguments):
        from hudepth.help import help_text

        print(help_text(task))
        return 0
    if arguments == ["--version"]:
        from hudepth import __version__

        print(f"hudepth {__version__}")
        return 0
    completes = any(argument.startswith("query=") for argument in arguments)
    if completes:
        from hudepth.help import complete

        complete(task)
    debug = [argument for argument in arguments if argument in ("debug=true", "debug=false")]
    try:
        sys.argv[1:] = rewrite(task, [argument for argument in arguments if argument not in debug])
        _check_flags(task, sys.argv[1:])
        _check_groups(sys.argv[1:])
        return _run_hydra(task)
    except KeyboardInterrupt:
        return 130
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except Exception as error:
        if "debug=true" in debug or isinstance(error, BrokenPipeError):
            raise
        if not completes:  # a line that is not finished is no mistake
            _print_mistake(error, task)
        return 1


def _print_mistake(error: Exception, task: str) -> None:
    from hudepth.base.console import print_error

    print_error(f"hudepth-{task}: {one_line(error, task)}")


def __getattr__(name: str) -> Callable[[], int]:
    """Return the function of the console script ``hudepth-<name>``; it returns an exit code."""
    if name in commands():
        return partial(_script, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def rewrite(task: str, arguments: list[str]) -> list[str]:
    """Turn what people type into what Hydra expects.

    ``experiment=x`` becomes ``+experiment=x``; ``hudepth-data prepare`` becomes ``verb=prepare``; where the rest of
    ``data`` is in a checkpoint, a ``data.root=x`` without ``data=`` becomes ``++data.root=x``. Paths are quoted.

    Args:
        task: the word after ``hudepth-``.
        arguments: without the program's name.

    Raises:
        ConfigError: if ``hudepth-data`` or ``hudepth-report`` is given no verb.
    """
    multirun = any(a in ("-m", "--multirun") for a in arguments)
    arguments = [_quote_path(argument, multirun=multirun) for argument in arguments]
    result = [f"+{a}" if a.startswith(tuple(f"{g}=" for g in ADDED_GROUPS)) else a for a in arguments]
    if task in SUBCOMMANDS and not any(a.startswith(_VERBLESS) for a in result):
        verbs = [a for a in result if a in SUBCOMMANDS[task]]
        words = [a for a in result if "=" not in a and not a.startswith("-")]
        if not verbs and any(a.startswith(_LOOKS) for a in result):
            return result
        if not verbs:
            got = f"no verb '{words[0]}'.{did_you_mean(words[0], SUBCOMMANDS[task])}" if words else "a verb is missing."
            raise ConfigError(f"{got} Type hudepth-{task} followed by {' or '.join(SUBCOMMANDS[task])}.")
        result = [f"verb={a}" if a == verbs[0] else a for a in result]
    flags = [a for a in result if a in ("-m", "--multirun")]
    result = [*flags, *(a for a in result if a not in flags)]  # between overrides argparse would stumble over them
    if any(a.startswith("resume=") for a in result):  # the keys are those of the run, which Hydra does not know
        result = [f"++{a}" if "." in a.partition("=")[0] and a[0] not in "+~" else a for a in result]
    if task in ("test", "report", "export") and not any(a.startswith(("data=", "+data=")) for a in result):
        result = [f"++{a}" if a.startswith("data.") else a for a in result]
    return result


def _quote_path(argument: str, *, multirun: bool) -> str:
    """Quote the path in ``key=path``: to Hydra, ``2011_09_26`` is a number, and ``a=b`` or ``x (1)`` are mistakes.

    Lists, quoted values, interpolations, and in a multirun values with a comma stay as they are, unless they exist.
    """
    key, separator, value = argument.partition("=")
    if not separator or key.lstrip("+~") not in PATHS or "${" in value:
        return argument
    constant = value.lower() in ("", "null", "true", "false")
    meant = constant or re.fullmatch(r"'.*'|\".*\"|\[.*\]", value) or (multirun and "," in value)
    word = re.fullmatch(r"[A-Za-z/.][\w/.-]*", value, re.ASCII) and not constant and value.lower() not in ("nan", "inf")
    if word or (meant and not os.path.lexists(value)):
        return argument
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + found[2].replace("'", "\\'"), value)
    return f"{key}='{escaped}'"


def _check_flags(task: str, arguments: list[str]) -> None:
    """Refuse what Hydra's parser does not take, for which it would print how it is used.

    Raises:
        ConfigError: for these, for words that are no ``key=value``, and for shell completion without saying for which
            shell.
    """
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        fix = "Write key=value, after flags such as --cfg job."
        for flag, following in zip(arguments, [*arguments[1:], ""], strict=True):
            name, _, value = flag.partition("=")
            if re.match("--?[A-Za-z]", flag) and (value or name not in parser._option_string_actions):
                key = name.lstrip("-").replace("-", "_")
                known = known_keys(task)
                key = key if key in known else closest(key, known)
                plain_value = following if re.fullmatch("[^-=][^=]*", following) else "<value>"
                fix = f"Pass {key}={value or plain_value}, without dashes." if key else fix
                break
        raise ConfigError(f"{message}. {fix}")

    parser.error = refuse  # type: ignore[method-assign]
    given = parser.parse_args(arguments)
    if task in _SUBJECT and (bare := [word for word in given.overrides if "=" not in word and word[0] != "~"]):
        raise ConfigError(f"'{bare[0]}': its key is missing. Pass {_SUBJECT[task]}={bare[0]}.")
    if given.shell_completion and not re.match("(un)?install=|query=", " ".join(given.overrides)):
        raise ConfigError("--shell-completion: what is missing. Pass -sc install=bash, or uninstall=bash.")


def _check_groups(arguments: list[str]) -> None:
    """Refuse what Hydra would misread: several choices of a group, of which it would take parts of each.

    Raises:
        ConfigError: for these, and for a launcher whose package is missing: Hydra blames whatever has a comma in it.
    """
    for argument in arguments:
        group, _, name = argument.partition("=")
        key = group.lstrip("+~")
        if name and not name.startswith("~") and (conf_folder() / key).is_dir() and not re.search(r"[()$]", name):
            choices = name.strip("[]").split(",")
            if not all(_WORD.fullmatch(each.strip()) for each in choices):
                raise ConfigError(f"{key}: no '{name[:40]}'. Pass one of {', '.join(options_of(key))}.")
            if name[0] == "[" and key not in ("protocol", "logger", *ADDED_GROUPS):
                sweep = f"-m {group}={','.join(choices)}"
                raise ConfigError(
                    f"{group}: takes one choice, not {name}. Pass {group}={choices[0]}, or sweep: {sweep}."
                )
        if group == "hydra/launcher" and name in LAUNCHERS:
            package = f"hydra_plugins.hydra_{name.partition('_')[0]}_launcher"
            if importlib.util.find_spec(package) is None:
                raise ConfigError(
                    f"{argument}: its package is not installed. Run pip install 'hudepth[{LAUNCHERS[name]}]'."
                )


def _run_hydra(task: str) -> int:
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing; one_line() words the error
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.plugins import Plugins
    from hydra.types import RunMode

    if task == "train":
        from hudepth.sweep.sweeper import Sweep

        # Hydra takes sweepers of this name only. What is installed as hydra_plugins, every program with Hydra imports.
        Plugins.instance().class_name_to_class["hydra_plugins.hudepth.Sweep"] = Sweep
    errors: list[Exception] = []

    def job(cfg: Any) -> Any:  # pickled by launchers that run jobs in other processes
        if task == "train" and HydraConfig.get().mode == RunMode.MULTIRUN:
            return importlib.import_module("hudepth.sweep.job").run_job(cfg)
        from hudepth.base.console import setup_logging

        setup_logging()
        try:
            verb = str(cfg.get("verb") or "")
            name = verb if (task, verb) in OWN_COMMAND else task
            run: Callable[[Any], Any] = getattr(importlib.import_module(module_of(name)), name)
            if task == "train":  # which resumes runs by what Hydra was given
                return run(cfg)
            return run({**plain(cfg), "overrides": list(HydraConfig.get().overrides.task)})
        except Exception as error:  # kept from Hydra, which would print it in its own way
            errors.append(error)
            return None

    hydra.main(config_path=str(conf_folder()), config_name=task, version_base="1.3")(job)()
    for error in errors[:-1]:
        _print_mistake(error, task)
    if errors:
        raise errors[-1]
    return 0
