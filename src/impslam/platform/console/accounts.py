"""The passwords: one for who may drive, one for who may watch, hashed in a file of their owner's.

The hash is scrypt (Percival 2009; RFC 7914). Its cost is what the paper proposes for a login that a
person waits for: 2^14 blocks of 8 * 128 bytes, so 16 MB, 30 ms on a desktop's core and below 100 ms
on an ARM board's. The file says the cost it was made with, so that a later one may be higher.
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

SHORTEST, LONGEST = 8, 256  # characters; NIST SP 800-63B sec. 3.1.1.2 asks for 8 and 64 at least
BLOCKS, BLOCK, LANES = 2**14, 8, 1  # scrypt's N, r and p
DIGEST, SALT = 32, 16  # bytes
MEMORY = 2**28  # bytes; what a cost in the file may ask for at most

_PRIVATE = stat.S_IRWXG | stat.S_IRWXO  # what nobody but the owner may have


class AccountsError(ImpError):
    """Passwords that cannot be read, kept or used: what, and what to do."""


class _Cost(BaseModel):
    """Scrypt's parameters, within what the memory of a small board allows."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    blocks: Annotated[int, Field(ge=2, le=2**20)] = BLOCKS
    block: Annotated[int, Field(ge=1, le=64)] = BLOCK
    lanes: Annotated[int, Field(ge=1, le=64)] = LANES

    def hash(self, password: str, salt: bytes) -> bytes:
        return hashlib.scrypt(
            _bytes(password),
            salt=salt,
            n=self.blocks,
            r=self.block,
            p=self.lanes,
            maxmem=MEMORY,
            dklen=DIGEST,
        )


class _Book(BaseModel):
    """What the file holds. One salt for both, so that a login costs one hash, whichever it is."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    salt: Base64Bytes
    cost: _Cost = _Cost()
    drive: Base64Bytes | None = None
    watch: Base64Bytes | None = None

    def right(self, digest: bytes) -> Right | None:
        """Return the right that a hash gives; both are compared, in constant time each."""
        drives = hmac.compare_digest(self.drive or b"", digest)
        watches = hmac.compare_digest(self.watch or b"", digest)
        return "drive" if drives else "watch" if watches else None


class Accounts:
    """Who may drive and who may watch; read anew whenever the file has changed.

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
            If the file is not as it should be, or can be read by others.
        """
        book = self._read()
        given: Mapping[Right, bytes | None] = {"drive": book.drive, "watch": book.watch}
        return frozenset(right for right, digest in given.items() if digest)

    def right(self, password: str) -> Right | None:
        """Return the right that a password gives, None where it gives none; takes some 50 ms.

        Raises
        ------
        AccountsError
            As `rights`.
        """
        book = self._read()
        right = book.right(book.cost.hash(password[:LONGEST], book.salt))
        return right if len(password) <= LONGEST else None

    def set(self, right: Right, password: str) -> None:
        """Set the password of a right; every session of a running server then ends.

        Raises
        ------
        AccountsError
            If it is too short or too long, the same as that of the other right (the password alone
            tells which is meant), or cannot be kept.
        """
        if not SHORTEST <= len(password) <= LONGEST:
            raise AccountsError(
                f"a password has {SHORTEST} to {LONGEST} characters; choose another"
            )
        book = self._read()
        digest = book.cost.hash(password, book.salt)
        if book.right(digest) not in {None, right}:
            raise AccountsError("this is the password of the other right; choose another")
        self._write(book.model_copy(update={right: digest}))

    def remove(self, right: Right) -> None:
        """Take the password of a right away, so that nobody gets it any more."""
        self._write(self._read().model_copy(update={right: None}))

    def version(self) -> tuple[int, int, int]:
        """Return what differs once the file has changed."""
        try:
            found = self.path.stat()
        except OSError:
            return 0, 0, 0
        return found.st_ino, found.st_mtime_ns, found.st_size

    def _read(self) -> _Book:
        try:
            with self.path.open("rb") as file:
                mode = os.fstat(file.fileno()).st_mode
                text = file.read()
        except FileNotFoundError:
            return _Book.model_construct(salt=secrets.token_bytes(SALT))
        except OSError as error:
            raise AccountsError(f"{self.path}: {error.strerror}; make it yours to read") from None
        if mode & _PRIVATE:
            raise AccountsError(
                f"{self.path} can be read by others (mode {stat.S_IMODE(mode):04o}): "
                f"`chmod 600 {self.path}`, and set new passwords"
            )
        try:
            return _Book.model_validate_json(text)
        except ValidationError:
            raise AccountsError(
                f"{self.path} is not a file of passwords; remove it, and set them anew"
            ) from None

    def _write(self, book: _Book) -> None:
        try:
            write_private(self.path, book.model_dump_json(exclude_none=True).encode())
        except OSError as error:
            raise AccountsError(f"{self.path}: {error.strerror}; nothing was changed") from None


def folder() -> Path:
    """Return the folder of what belongs to the user: passwords, and the certificate's key."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".config") / "impslam"


def write_private(path: Path, data: bytes) -> None:
    """Write a file that its owner alone can read (mode 0600), wholly or not at all.

    Raises
    ------
    OSError
        If it cannot be written; what was there before still is.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        dir=path.parent, prefix=f".{path.name}."
    )  # mkstemp's mode: 0600
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


def _bytes(password: str) -> bytes:
    """Return what is hashed: the same for one password however a keyboard composes its letters."""
    return unicodedata.normalize("NFC", password).encode("utf-8", "replace")
