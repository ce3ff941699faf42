"""Certificates arrive on a machine: what was exported for it is checked and laid where its services look."""

from __future__ import annotations

import contextlib
import datetime as dt
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from services.common.errors import InputError
from services.common.files import make_folder, write_whole
from services.security.authority import CA_CERTIFICATE, CA_KEY
from services.security.identity import Identity
from services.security.register import Register


@dataclass(frozen=True, slots=True)
class Brought:
    """What an import did to the machine's folder."""

    files: tuple[Path, ...]
    changed: tuple[Identity, ...]
    """Of those whose other pair was there before: what runs with them shows the old one until it connects anew."""
    revoked: tuple[str, ...]
    """Identities that hold no certificate any more: their pairs were left out, and removed where they were here."""


def bring(source: Path, to: Path, now: dt.datetime) -> Brought:
    """Copy what ``certs export`` put into ``source`` to this machine's folder, after looking at all of it.

    The files belong to the folder's owner afterwards (the services' user), also when an administrator brings them. The list
    comes last: a router that runs starts anew with it, and whoever then connects again has to find the pair that it names.
    A revoked pair whose identity holds no other is passed over, and taken away where it was here: no export replaces it.

    Raises:
        InputError: something is missing, damaged, expired, revoked or of another authority, or older than what the machine
            has; nothing was copied then.
    """
    if (source / CA_KEY).exists():
        raise InputError(
            f"{source / CA_KEY}: the authority's own key may not leave its folder; `treedock certs export` leaves it out"
        )
    authority = _certificate(source / CA_CERTIFICATE)
    register = Register.read(source)
    valid = register.valid_names()
    names, changed = [CA_CERTIFICATE], []
    ended = [path for folder in (source, to) for path in _pairs(folder) if _ended(path, register)]
    for path in _pairs(source):
        if path in ended:
            continue
        certificate = _check(path, authority, valid)
        if certificate.not_valid_after_utc <= now:
            end = f"{certificate.not_valid_after_utc:%Y-%m-%d}"
            raise InputError(f"{path}: expired on {end}; `treedock certs renew` first")
        names += [path.name, path.with_suffix(".key").name]
        if _another(path, to / path.name):
            changed.append(Identity.parse(path.stem))
    names.append(Register.FILE)
    _check_later(to, authority, register, names, source)
    make_folder(to, 0o700)
    owner = to.stat()
    for name in names:
        write_whole(to / name, (source / name).read_bytes(), 0o600 if name.endswith(".key") else 0o644)
        with contextlib.suppress(PermissionError):  # only root may give files away, and only root needs to
            os.chown(to / name, owner.st_uid, owner.st_gid)
    for path in ended:
        if path.parent == to:
            path.unlink()
            path.with_suffix(".key").unlink(missing_ok=True)
    return Brought(tuple(to / name for name in names), tuple(changed), tuple(sorted({path.stem for path in ended})))


def _pairs(folder: Path) -> list[Path]:
    """Return the certificates of nodes in a folder."""
    return [path for path in sorted(folder.glob("*.pem")) if path.name != CA_CERTIFICATE]


def _ended(path: Path, register: Register) -> bool:
    """Return whether a certificate is revoked, and its identity holds no later one that an export would bring."""
    try:
        name = _name(_certificate(path))
    except InputError:  # damaged: told where it is checked
        return False
    entry = next((entry for entry in register.entries if entry.common_name == name), None)
    return entry is not None and register.valid_until(entry.identity) is None


def _name(certificate: x509.Certificate) -> str:
    return str(certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)[0].value)


def _another(path: Path, there: Path) -> bool:
    try:
        return there.read_bytes() != path.read_bytes()
    except OSError:
        return False


def _check_later(
    to: Path, authority: x509.Certificate, register: Register, names: Collection[str], source: Path
) -> None:
    """Refuse a list that would give revoked certificates their rights back, or leave pairs that nobody here believes."""
    try:
        same = _certificate(to / CA_CERTIFICATE) == authority
        had = Register.read(to).entries
    except InputError:  # nothing is there yet, or it is damaged: whatever comes is better
        return
    away = f"export it again, or move {to} away first"
    if not same:
        left = sorted(path.name for path in to.glob("*.pem") if path.name not in names)
        if left:
            raise InputError(
                f"{source / CA_CERTIFICATE}: is another authority than {to / CA_CERTIFICATE}, and {', '.join(left)} "
                f"there would fit no more: export those with it, or move {to} away first"
            )
        return
    brought = {entry.common_name: entry.revoked for entry in register.entries}
    for entry in had:
        if entry.revoked and brought.get(entry.common_name) is False:
            raise InputError(f"{source / Register.FILE}: is old, {entry.common_name} was revoked since; {away}")
        if entry.common_name not in brought:
            raise InputError(f"{source / Register.FILE}: is old, {entry.common_name} was issued since; {away}")


def faults_in(folder: Path) -> list[str]:
    """Return why nodes that show themselves by this folder's files would be refused, but for their age: that is told apart."""
    try:
        authority, valid = _certificate(folder / CA_CERTIFICATE), Register.read(folder).valid_names()
    except InputError as error:
        return [str(error)]
    pairs = _pairs(folder)
    faults = [] if pairs else [f"{folder}: holds no node's certificate"]
    for path in pairs:
        try:
            _check(path, authority, valid)
        except InputError as error:
            faults.append(str(error))
    return faults


def _check(path: Path, authority: x509.Certificate, valid: dict[str, Identity]) -> x509.Certificate:
    certificate = _certificate(path)
    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        raise InputError(f"{path}: is of another authority than the {CA_CERTIFICATE} beside it") from None
    name = _name(certificate)
    if name not in valid:
        held = path.stem in {identity.text for identity in valid.values()}
        do = "export it again" if held else f"remove it (rm {path} {path.with_suffix('.key')}), or issue and export it"
        raise InputError(f"{path}: {name} is revoked or not in {Register.FILE}; {do}")
    if valid[name].text != path.stem:
        raise InputError(f"{path}: is the certificate of {valid[name].text}; export {path.stem} again")
    key = path.with_suffix(".key")
    try:
        private = serialization.load_pem_private_key(key.read_bytes(), password=None)
    except OSError as error:
        raise InputError(f"{key}: {error.strerror}; export it again") from error
    except ValueError as error:
        raise InputError(f"{key}: damaged ({error}); export it again") from error
    if private.public_key() != certificate.public_key():
        raise InputError(f"{key}: does not belong to {path.name}; export both again")
    return certificate


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; `treedock certs export` puts it there") from error
    except ValueError as error:
        raise InputError(f"{path}: damaged ({error}); export it again") from error
