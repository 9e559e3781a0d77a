"""The passwords to drive and to watch, hashed in a private file.

The hash is scrypt (Percival 2009; RFC 7914), with the cost that the paper proposes for interactive
logins: 2^14 blocks of 8 * 128 bytes, so 16 MB, 30 ms on a desktop core and below 100 ms on that of an
ARM board. The file stores its cost, so that a later version may use a higher one.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import stat
import tempfile
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Base64Bytes, BaseModel, ConfigDict, Field, ValidationError

from impslam.errors import ImpError
from impslam.platform.console.session import Right

MIN_LENGTH, MAX_LENGTH = 8, 256
"""characters; NIST SP 800-63B sec. 3.1.1.2 requires at least 8 and 64."""
BLOCKS, BLOCK, LANES = 2**14, 8, 1  # scrypt's N, r and p
DIGEST_SIZE, SALT_SIZE = 32, 16  # bytes
MAX_MEMORY = 2**28  # bytes that the cost in the file may require

_PRIVATE = stat.S_IRWXG | stat.S_IRWXO  # permissions that only the owner may have


class AccountsError(ImpError):
    """Passwords that cannot be read, stored or used; the message says what to do."""


class _Cost(BaseModel):
    """The parameters of scrypt, limited to the memory of a small board."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    blocks: Annotated[int, Field(ge=2, le=2**20)] = BLOCKS
    block: Annotated[int, Field(ge=1, le=64)] = BLOCK
    lanes: Annotated[int, Field(ge=1, le=64)] = LANES

    def hash(self, password: str, salt: bytes) -> bytes:
        return hashlib.scrypt(
            _normalised(password),
            salt=salt,
            n=self.blocks,
            r=self.block,
            p=self.lanes,
            maxmem=MAX_MEMORY,
            dklen=DIGEST_SIZE,
        )


class _PasswordFile(BaseModel):
    """The contents of the file; both passwords share a salt, so that a login costs one hash."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    salt: Base64Bytes
    cost: _Cost = _Cost()
    drive: Base64Bytes | None = None
    watch: Base64Bytes | None = None

    def right(self, digest: bytes) -> Right | None:
        """Return the right that a hash grants, or None; both are compared in constant time."""
        drives = hmac.compare_digest(self.drive or b"", digest)
        watches = hmac.compare_digest(self.watch or b"", digest)
        return "drive" if drives else "watch" if watches else None


class Accounts:
    """The passwords to drive and to watch; the file is read at each call.

    Parameters
    ----------
    path : the file; None is `accounts.json` in `~/.config/impslam` (or `$XDG_CONFIG_HOME/impslam`)
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or folder() / "accounts.json"

    def rights(self) -> frozenset[Right]:
        """Return the rights that have a password.

        Raises
        ------
        AccountsError
            If the file is invalid, or can be read by others.
        """
        stored = self._read()
        digests: Mapping[Right, bytes | None] = {"drive": stored.drive, "watch": stored.watch}
        return frozenset(right for right, digest in digests.items() if digest)

    def right(self, password: str) -> Right | None:
        """Return the right that a password grants, or None; takes some 50 ms.

        Raises
        ------
        AccountsError
            As `rights`.
        """
        stored = self._read()
        right = stored.right(stored.cost.hash(password[:MAX_LENGTH], stored.salt))
        return right if len(password) <= MAX_LENGTH else None

    def set(self, right: Right, password: str) -> None:
        """Set the password of a right; every session of a running server then ends.

        Raises
        ------
        AccountsError
            If it is too short or too long, equal to that of the other right (a login has only the
            password), or cannot be stored.
        """
        if not MIN_LENGTH <= len(password) <= MAX_LENGTH:
            raise AccountsError(
                f"a password has {MIN_LENGTH} to {MAX_LENGTH} characters; choose another"
            )
        stored = self._read()
        digest = stored.cost.hash(password, stored.salt)
        if stored.right(digest) not in {None, right}:
            raise AccountsError("this is the password of the other right; choose another")
        self._write(stored.model_copy(update={right: digest}))

    def remove(self, right: Right) -> None:
        """Remove the password of a right, so that nobody can get it."""
        self._write(self._read().model_copy(update={right: None}))

    def version(self) -> tuple[int, int, int]:
        """Return a value that differs when the file has changed."""
        try:
            found = self.path.stat()
        except OSError:
            return 0, 0, 0
        return found.st_ino, found.st_mtime_ns, found.st_size

    def _read(self) -> _PasswordFile:
        try:
            with self.path.open("rb") as file:
                mode = os.fstat(file.fileno()).st_mode
                text = file.read()
        except FileNotFoundError:
            return _PasswordFile.model_construct(salt=secrets.token_bytes(SALT_SIZE))
        except OSError as error:
            raise AccountsError(
                f"{self.path}: {error.strerror}; make it readable for your user"
            ) from None
        if mode & _PRIVATE:
            raise AccountsError(
                f"{self.path} can be read by others (mode {stat.S_IMODE(mode):04o}): "
                f"`chmod 600 {self.path}`, and set new passwords"
            )
        try:
            return _PasswordFile.model_validate_json(text)
        except ValidationError:
            raise AccountsError(
                f"{self.path} is not a file of passwords; remove it, and set the passwords again"
            ) from None

    def _write(self, stored: _PasswordFile) -> None:
        try:
            write_private(self.path, stored.model_dump_json(exclude_none=True).encode())
        except OSError as error:
            raise AccountsError(f"{self.path}: {error.strerror}; nothing was changed") from None


def folder() -> Path:
    """Return the user's folder of passwords and the key of the certificate."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".config") / "impslam"


def write_private(path: Path, data: bytes) -> None:
    """Write a file atomically that only its owner can read (mode 0600).

    Raises
    ------
    OSError
        If it cannot be written; an existing file is then unchanged.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise


def _normalised(password: str) -> bytes:
    """Return the bytes to hash, independent of how a keyboard composes accented letters."""
    return unicodedata.normalize("NFC", password).encode("utf-8", "replace")
