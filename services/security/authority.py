"""A certificate authority for one fleet: one certificate per service and station, kept in a folder.

The authority's folder holds ``ca.pem``, ``ca.key`` and ``identities.json`` (everything ever issued); what a machine
needs is copied from it by ``export``: the CA's certificate, the list, and the pairs of the nodes that run there.
Private keys are readable by their owner only.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from services.common.errors import InputError
from services.common.files import make_folder, write_whole
from services.security.identity import Identity
from services.security.register import Issued, Register

CA_CERTIFICATE, CA_KEY = "ca.pem", "ca.key"
CA_DAYS = 3650
NODE_DAYS = 397
_HOST_NAME = re.compile(r"(?!.{254})(?![0-9.]+\Z)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\Z")
"""What consists of digits and points alone is an address that was mistyped."""
_BACKDATED = dt.timedelta(minutes=5)
"""A companion computer's clock may be a little behind the authority's."""


@dataclass(frozen=True, slots=True)
class Authority:
    """The folder of the certificate authority, opened."""

    folder: Path
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    register: Register

    @classmethod
    def create(cls, folder: Path, now: dt.datetime, days: int = CA_DAYS) -> Authority:
        """Make a new authority in an empty folder.

        Raises:
            InputError: there is one already, or the folder cannot be written.
        """
        if (folder / CA_CERTIFICATE).exists() or (folder / CA_KEY).exists():
            raise InputError(f"{folder} already holds an authority: give another folder, or go on with `certs issue`")
        make_folder(folder, 0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "treedock authority")])
        certificate = (
            _builder(name, name, key.public_key(), now, days)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        write_whole(folder / CA_KEY, _pem_key(key), 0o600)
        write_whole(folder / CA_CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        register = Register(())
        register.write(folder)
        return cls(folder, certificate, key, register)

    @classmethod
    def open(cls, folder: Path) -> Authority:
        """Open an existing authority.

        Raises:
            InputError: a file is missing or not what it should be.
        """
        try:
            certificate = x509.load_pem_x509_certificate((folder / CA_CERTIFICATE).read_bytes())
            key = serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), password=None)
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror}; `treedock certs init` makes an authority") from error
        except ValueError as error:
            raise InputError(f"{folder}: {CA_CERTIFICATE} or {CA_KEY} is damaged: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise InputError(f"{folder / CA_KEY}: not a key that `treedock certs init` made")
        return cls(folder, certificate, key, Register.read(folder))

    def issue(
        self, identity: Identity, now: dt.datetime, days: int = NODE_DAYS, hosts: Sequence[str] = ()
    ) -> Authority:
        """Issue a certificate; an earlier one of the same identity is revoked. Returns the authority as it is then.

        Args:
            identity: whose.
            now: the moment (UTC).
            days: validity.
            hosts: addresses and names under which a router is reached; they are checked by those who connect.

        Raises:
            InputError: the authority itself ends earlier, or the folder cannot be written.
        """
        last = self.certificate.not_valid_after_utc
        if now + dt.timedelta(days=days) > last:
            left = (last - now).days
            do = f"--days {left} at most, or " if left > 0 else ""
            raise InputError(
                f"{identity.text}: {days} days go beyond the authority's own end ({last:%Y-%m-%d}): {do}make a new one "
                "(`treedock certs init --folder ANOTHER`), and issue all certificates anew there"
            )
        generation = self.register.next_generation(identity.text)
        common_name = f"{identity.text}.{generation}"
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
        certificate = (
            _builder(subject, self.certificate.subject, key.public_key(), now, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs=False), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]),
                critical=False,
            )
            .add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts or ("localhost",)]), critical=False)
            .sign(self.key, hashes.SHA256())
        )
        write_whole(self.folder / f"{identity.text}.key", _pem_key(key), 0o600)
        write_whole(self.folder / f"{identity.text}.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        entry = Issued(
            common_name, identity.text, f"{certificate.serial_number:x}", _text(certificate.not_valid_before_utc),
            _text(certificate.not_valid_after_utc), tuple(hosts),
        )  # fmt: skip
        return self._with(self.register.revoked(identity.text).added(entry))

    def revoke(self, identity: Identity) -> Authority:
        """Take all rights from an identity's certificates.

        Raises:
            InputError: none is valid, or the folder cannot be written.
        """
        self.holding(identity)
        return self._with(self.register.revoked(identity.text))

    def holding(self, identity: Identity) -> None:
        """Refuse an identity without rights.

        Raises:
            InputError: it holds no certificate, or none that is not revoked.
        """
        if not any(e.identity == identity.text and not e.revoked for e in self.register.entries):
            raise InputError(f"{identity.text}: no valid certificate was issued; `treedock certs list` shows them")

    def _with(self, register: Register) -> Authority:
        register.write(self.folder)
        return Authority(self.folder, self.certificate, self.key, register)

    def export(self, identities: Iterable[Identity], folder: Path) -> list[Path]:
        """Copy to ``folder`` what a machine with these nodes needs; never the authority's key. Returns the files.

        Raises:
            InputError: a pair was not issued or is revoked, or the folder cannot be written.
        """
        identities = list(identities)
        for identity in identities:
            self.holding(identity)
        make_folder(folder, 0o700)
        pairs = [f"{identity.text}{end}" for identity in identities for end in (".pem", ".key")]
        files = []
        # the list last: a router may look here, and takes up rights as soon as it changes
        for name in (CA_CERTIFICATE, *pairs, Register.FILE):
            try:
                body = (self.folder / name).read_bytes()
            except OSError as error:
                raise InputError(f"{self.folder / name}: {error.strerror}; `treedock certs issue` makes it") from error
            write_whole(folder / name, body, 0o600 if name.endswith(".key") else 0o644)
            files.append(folder / name)
        return files


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: dt.datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _key_usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs, key_cert_sign=signs, crl_sign=signs, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        if not _HOST_NAME.match(text):
            raise InputError(f"--host {text!r}: expected an address (10.0.0.7) or a name (kea.local)") from None
        return x509.DNSName(text)


def _pem_key(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _text(moment: dt.datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
