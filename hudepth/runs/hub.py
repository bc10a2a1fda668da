"""Models on the Hugging Face Hub: ``hf:owner/name`` wherever a checkpoint is asked for, and publishing bundles.

What travels is a bundle (:mod:`hudepth.runs.bundles`). Only its configuration and weights are downloaded, into the
cache of huggingface_hub, and they are read like any stranger's. ``HF_TOKEN``, ``HF_HOME``, ``HF_ENDPOINT`` and
``HF_HUB_OFFLINE`` mean what they mean to huggingface_hub.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, ConfigError, HudepthError, first_line
from hudepth.runs.bundles import CONFIG, MAX_CONFIG_BYTES, MAX_WEIGHTS_BYTES, WEIGHTS

PREFIX = "hf:"
TIMEOUT_S = 10
FILES = {CONFIG: MAX_CONFIG_BYTES, WEIGHTS: MAX_WEIGHTS_BYTES}
_LOGIN = "Run hf auth login, or set HF_TOKEN"


def download(spec: str, *, key: str) -> Path:
    """Return the folder of ``hf:owner/name`` or ``hf:owner/name@revision`` in the local cache.

    ``key`` is the option that names it. Without a network it is what the cache holds. Raises CheckpointError if there
    is no such model, it is private or no bundle, or the Hub cannot be reached; ConfigError if huggingface_hub is not
    installed.
    """
    name, _, after = spec.removeprefix(PREFIX).partition("@")
    revision = after or None
    with _worded(key, spec, CheckpointError):
        from huggingface_hub import HfApi, errors, hf_hub_download

        try:
            found = HfApi().model_info(name, revision=revision, timeout=TIMEOUT_S, files_metadata=True)
        except errors.HFValidationError:
            raise
        except Exception as error:
            if getattr(getattr(error, "response", None), "status_code", 500) < 500:
                raise
            with suppress(errors.LocalEntryNotFoundError):
                files = [hf_hub_download(name, each, revision=revision, local_files_only=True) for each in FILES]
                log.warning("%s: the Hub does not answer; taken from the cache", spec)
                return Path(files[-1]).parent
            raise
        sizes = {each.rfilename: each.size or 0 for each in found.siblings or ()}
        for file, limit in FILES.items():
            if sizes.get(file, 0) > limit:
                raise CheckpointError(f"{key}: '{spec}' is refused: its {file} is larger than {limit >> 20} MiB.")
        files = [hf_hub_download(name, file, revision=revision) for file in FILES]
        return Path(files[-1]).parent


def check_login(name: str) -> None:
    """Raise ConfigError if ``owner/name`` cannot name a model, nobody is logged in, or the Hub cannot be reached."""
    with _worded("push", name, ConfigError):
        from huggingface_hub import HfApi

        if not re.fullmatch(r"[\w.-]+/[\w.-]+", name, re.ASCII):
            raise ConfigError(f"push: '{name}' is no name of the Hub. Write push=owner/name.")
        HfApi().whoami()


def push(folder: Path, name: str, *, private: bool) -> str:
    """Publish a bundle as the model ``owner/name``, new or as its next commit; return its address.

    Raises ConfigError if the Hub refuses it or cannot be reached; the bundle stays.
    """
    with _worded("push", name, ConfigError):
        from huggingface_hub import HfApi

        address = HfApi().create_repo(name, private=private, exist_ok=True)
        HfApi().upload_folder(repo_id=name, folder_path=folder, commit_message="Upload a model of hudepth")
    return str(address)


@contextmanager
def _worded(key: str, name: str, kind: type[HudepthError]) -> Iterator[None]:
    """Turn what huggingface_hub raises into one line with the fix."""
    try:
        from huggingface_hub import errors
    except ImportError:
        raise ConfigError(f"{key}: '{name}' needs huggingface_hub. Run pip install 'hudepth[hub]'.") from None
    where = f"{key}: '{name}'"
    try:
        yield
    except errors.HFValidationError:
        raise kind(f"{where} is no name of the Hub. Write {'' if key == 'push' else PREFIX}owner/name.") from None
    except errors.LocalTokenNotFoundError:
        raise kind(f"{where}: nobody is logged in to the Hugging Face Hub. {_LOGIN}.") from None
    except errors.GatedRepoError:
        raise kind(f"{where} asks to accept its terms. Do so on its page, and be logged in: {_LOGIN}.") from None
    except errors.RepositoryNotFoundError:
        raise kind(f"{where}: the Hub has no such model, or it is private. Check its name. {_LOGIN}.") from None
    except errors.RevisionNotFoundError:
        raise kind(f"{where}: the model has no such revision. Leave out what follows the @.") from None
    except errors.RemoteEntryNotFoundError:
        fix = "Pass one published by hudepth-export format=bundle push=owner/name"
        raise kind(f"{where} is not a bundle of hudepth: it lacks {CONFIG} or {WEIGHTS}. {fix}.") from None
    except HudepthError:
        raise
    except Exception as error:  # of httpx, the disk, and more
        response = getattr(error, "response", None)
        if (status := getattr(response, "status_code", None)) in (401, 403):
            raise kind(f"{where}: the Hub refuses it ({status}). Use a token that may do so: {_LOGIN}.") from None
        if isinstance(error, OSError) and error.errno:
            raise kind(f"{where}: cannot write its files ({error.strerror}). Set HF_HOME=<another folder>.") from None
        online = "Unset HF_HUB_OFFLINE" if isinstance(error, errors.OfflineModeIsEnabled) else "Go online"
        reason = f"error {status}" if status else first_line(error).split(". ")[0]
        raise kind(f"{where}: the Hub does not answer ({reason}). {online}.") from error
