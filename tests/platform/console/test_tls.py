import datetime
import ipaddress
import socket
import ssl
import stat
import subprocess
import threading

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from impslam.errors import ImpError
from impslam.platform.console import hosts, tls
from impslam.platform.console.tls import (
    LIFETIME,
    CertificateError,
    CertificateFiles,
    own_certificate,
)

NAMES, ADDRESSES = ("robot", "robot.local"), ("10.0.0.5", "fd00::5")


@pytest.fixture
def pem(tmp_path):
    return own_certificate(tmp_path / "new", NAMES, ADDRESSES)


def read(pem):
    return x509.load_pem_x509_certificate(pem.certificate.read_bytes())


def names(pem):
    found = read(pem).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    addresses = [str(address) for address in found.get_values_for_type(x509.IPAddress)]
    return {*found.get_values_for_type(x509.DNSName), *addresses}


class TestOwnCertificate:
    def test_it_is_for_the_names_and_addresses_and_nothing_else(self, pem):
        found = read(pem)
        assert names(pem) == {*NAMES, *ADDRESSES}
        key = found.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        assert key.curve.name == "secp256r1"
        assert found.not_valid_after_utc - found.not_valid_before_utc == LIFETIME
        assert datetime.timedelta(days=825) >= LIFETIME
        basic = found.extensions.get_extension_for_class(x509.BasicConstraints)
        assert not basic.value.ca

    def test_the_key_is_private(self, pem):
        assert stat.S_IMODE(pem.key.stat().st_mode) == 0o600

    def test_it_is_kept(self, pem):
        before = pem.certificate.read_bytes()
        assert own_certificate(pem.key.parent, NAMES[:1], ADDRESSES[::-1]) == pem
        assert pem.certificate.read_bytes() == before

    def test_a_new_address_renews_it_and_going_back_does_not(self, pem):
        own_certificate(pem.key.parent, NAMES, ("192.168.1.7",))
        assert names(pem) == {*NAMES, *ADDRESSES, "192.168.1.7"}
        before = pem.fingerprint()
        own_certificate(pem.key.parent, NAMES, ADDRESSES)
        assert pem.fingerprint() == before

    def test_it_does_not_grow_for_ever(self, pem):
        for k in range(tls.MAX_NAMES + 3):
            own_certificate(pem.key.parent, NAMES, (f"10.0.1.{k}",))
        assert len(names(pem)) <= tls.MAX_NAMES
        assert {*NAMES, f"10.0.1.{tls.MAX_NAMES + 2}"} <= names(pem)

    @pytest.mark.parametrize("days", [800, 10_000, -5])
    def test_it_is_renewed_before_its_end_and_where_the_clock_was_wrong(
        self, pem, monkeypatch, days
    ):
        before = pem.fingerprint()
        moment = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
        monkeypatch.setattr(tls, "_now", lambda: moment)
        own_certificate(pem.key.parent, NAMES, ADDRESSES)
        assert pem.fingerprint() != before
        assert read(pem).not_valid_before_utc < moment < read(pem).not_valid_after_utc

    @pytest.mark.parametrize("broken", ["certificate", "key"])
    @pytest.mark.parametrize("content", [None, b"", b"nonsense"])
    def test_a_broken_certificate_is_replaced(self, pem, broken, content):
        before = pem.fingerprint()
        path = getattr(pem, broken)
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        own_certificate(pem.key.parent, NAMES, ADDRESSES)
        pem.context()
        assert pem.fingerprint() != before

    def test_a_folder_that_cannot_be_written_is_an_error(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(CertificateError, match="for your user"):
            own_certificate(tmp_path / "file", NAMES, ADDRESSES)

    def test_the_fingerprint_is_what_other_tools_show(self, pem):
        shown = subprocess.run(
            ["openssl", "x509", "-noout", "-fingerprint", "-sha256", "-in", pem.certificate],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        assert shown.strip().partition("=")[2] == pem.fingerprint()


class TestGivenPapers:
    @pytest.mark.parametrize("swap", ["certificate", "key", "both", "missing", "encrypted"])
    def test_an_unusable_certificate_is_a_one_line_error(self, pem, tmp_path, swap):
        other = own_certificate(tmp_path / "other", NAMES, ADDRESSES)
        nonsense = tmp_path / "nonsense.pem"
        nonsense.write_text("nonsense")
        encrypted = tmp_path / "encrypted.pem"
        subprocess.run(
            [
                *["openssl", "ec", "-aes128", "-passout", "pass:secret", "-in"],
                pem.key,
                "-out",
                encrypted,
            ],
            capture_output=True,
            check=True,
        )
        given = {
            "certificate": CertificateFiles(nonsense, pem.key),
            "key": CertificateFiles(pem.certificate, other.key),
            "both": CertificateFiles(pem.key, pem.certificate),
            "missing": CertificateFiles(tmp_path / "none", pem.key),
            "encrypted": CertificateFiles(pem.certificate, encrypted),
        }[swap]
        with pytest.raises(CertificateError, match="give a PEM certificate") as raised:
            given.context()
        assert "\n" not in str(raised.value)

    @pytest.mark.parametrize(
        ("version", "fits"),
        [
            (ssl.TLSVersion.TLSv1, False),
            (ssl.TLSVersion.TLSv1_1, False),
            (ssl.TLSVersion.TLSv1_2, True),
            (ssl.TLSVersion.TLSv1_3, True),
        ],
    )
    @pytest.mark.filterwarnings("ignore:ssl.TLSVersion.TLSv1:DeprecationWarning")
    def test_old_tls_versions_are_refused(self, pem, version, fits):
        client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.load_verify_locations(pem.certificate)
        client.set_ciphers("ALL:@SECLEVEL=0")  # else it is the client that refuses
        client.minimum_version = client.maximum_version = version
        near, far = socket.socketpair()
        with near, far:
            answer = threading.Thread(target=_serve, args=(pem.context(), far))
            answer.start()
            try:
                with client.wrap_socket(near, server_hostname="robot.local") as line:
                    assert fits
                    assert line.version() in {"TLSv1.2", "TLSv1.3"}
            except ssl.SSLError:
                assert not fits
            near.close()
            answer.join()


def _serve(context, line):
    try:
        context.wrap_socket(line, server_side=True).close()
    except OSError:
        line.close()


class TestHosts:
    @pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.1", "localhost", "::1"])
    def test_loopback_addresses(self, host):
        assert hosts.loopback(host)

    @pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "192.0.2.1", "fd00::1", ""])
    def test_other_addresses(self, host):
        assert not hosts.loopback(host or "0.0.0.0")

    @pytest.mark.parametrize("host", ["no such host", "-", "a" * 300, "."])
    def test_a_name_without_address_is_an_error(self, host):
        with pytest.raises(ImpError, match="no such name"):
            hosts.loopback(host)

    @pytest.mark.parametrize(
        ("name", "names"),
        [
            ("VM", ("vm", "vm.local", "localhost")),
            ("vm.local", ("vm.local", "vm", "localhost")),
            ("vm.example.org", ("vm.example.org", "vm", "vm.local", "localhost")),
        ],
    )
    def test_names_by_the_host_name(self, monkeypatch, name, names):
        monkeypatch.setattr(socket, "gethostname", lambda: name)
        assert hosts.names() == names
        assert hosts.mdns_name() == "vm.local"

    def test_names_and_addresses_of_this_computer(self):
        assert "localhost" in hosts.names()
        assert "127.0.0.1" in hosts.addresses()
        for address in hosts.addresses():
            assert not ipaddress.ip_address(address).is_link_local
