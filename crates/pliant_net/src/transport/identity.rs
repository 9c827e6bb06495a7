//! Identities: Ed25519 keys, their fingerprints, and the checks made in the TLS handshake.

use std::ffi::OsStr;
use std::fmt;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use rcgen::{CertificateParams, KeyPair, PKCS_ED25519, PublicKeyData};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{
    CryptoProvider, WebPkiSupportedAlgorithms, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error as TlsError, SignatureScheme,
};
use thiserror::Error;

/// The SHA-256 hash of a public key (its X.509 `SubjectPublicKeyInfo`), 32 bytes, written as 64
/// lower-case hexadecimal digits.
///
/// `openssl x509 -pubkey | openssl pkey -pubin -outform der | sha256sum` gives the same number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Fingerprint(pub [u8; 32]);

impl Fingerprint {
    /// Returns the SHA-256 hash of a name, for carriers that know users by names or numbers instead
    /// of keys. It proves nothing: the carrier answers for who has the name.
    pub fn of_name(name: &[u8]) -> Self {
        Self::sha256(name)
    }

    pub(super) fn of_public_key(spki: &[u8]) -> Self {
        Self::sha256(spki)
    }

    fn sha256(of: &[u8]) -> Self {
        let digest = ring::digest::digest(&ring::digest::SHA256, of);
        let mut bytes = [0; 32];
        for (to, from) in bytes.iter_mut().zip(digest.as_ref()) {
            *to = *from;
        }
        Self(bytes)
    }

    pub(super) fn of_certificate(certificate: &CertificateDer<'_>) -> Result<Self, TlsError> {
        let parsed = ParsedCertificate::try_from(certificate)?;
        Ok(Self::of_public_key(parsed.subject_public_key_info().as_ref()))
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_hex(f, &self.0)
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Fingerprint({self})")
    }
}

impl FromStr for Fingerprint {
    type Err = IdentityError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse_hex(text).map(Self).ok_or_else(|| IdentityError::Fingerprint { found: shortened(text) })
    }
}

pub(super) fn write_hex(f: &mut fmt::Formatter<'_>, bytes: &[u8]) -> fmt::Result {
    bytes.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
}

pub(super) fn parse_hex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digits = text.as_bytes();
    if digits.len() != 2 * N {
        return None;
    }
    let mut bytes = [0; N];
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        let [high, low] = [*pair.first()?, *pair.get(1)?].map(|digit| char::from(digit).to_digit(16));
        *byte = u8::try_from(high? * 16 + low?).ok()?;
    }
    Some(bytes)
}

/// Cuts text from the network, so that an error message stays short whatever its input.
pub(super) fn shortened(text: &str) -> String {
    const MAX: usize = 80;
    match text.char_indices().nth(MAX) {
        Some((end, _)) => format!("{}… ({} bytes)", &text[..end], text.len()),
        None => text.to_owned(),
    }
}

/// Why an identity or a fingerprint could not be made or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum IdentityError {
    /// The system's random source or the key generator failed.
    #[error("could not make an Ed25519 key: {0}")]
    Generate(String),
    /// The given private key is not an Ed25519 key in PKCS #8 form.
    #[error("expected an Ed25519 private key in PKCS #8 form: {0}")]
    Key(String),
    /// The given text is not a fingerprint.
    #[error("expected a fingerprint of 64 hexadecimal digits, found `{found}`")]
    Fingerprint {
        /// The text that was found instead, shortened.
        found: String,
    },
    /// The file of the key cannot be read or created.
    #[error("the key in {}: {source}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file of the key is empty. Another program, or an earlier version of this one, died
    /// before it had written a key. The file is left as it is, because its writer may still be at
    /// work.
    #[error("the key in {}: the file is empty; delete it to get a new key", path.display())]
    Empty {
        /// Path of the file.
        path: PathBuf,
    },
}

/// An Ed25519 key and the self-signed certificate that presents it in the handshake.
///
/// Keep it in a file ([`Identity::at`]), or store [`Identity::to_pkcs8`], to stay the same user, or
/// the same host behind the same invite, in later runs.
pub struct Identity {
    certificate: CertificateDer<'static>,
    key: KeyPair,
    fingerprint: Fingerprint,
}

impl fmt::Debug for Identity {
    /// Formats the identity without the private key.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Identity").field("fingerprint", &self.fingerprint).finish_non_exhaustive()
    }
}

impl Identity {
    /// Creates a new key from the system's random source.
    pub fn generate() -> Result<Self, IdentityError> {
        let key = KeyPair::generate_for(&PKCS_ED25519)
            .map_err(|error| IdentityError::Generate(error.to_string()))?;
        Self::from_key(key)
    }

    /// Reads the key in a file, or makes a key and creates the file with it. A file that this
    /// function creates was never readable for anyone but its owner (mode 0600, on Unix), and has
    /// its name only when the whole key is in it and synced. Of several callers at one moment, in
    /// any number of processes, all get the key of the first.
    ///
    /// Where the file system has no hard links, the file has its name from the beginning: a caller
    /// at the same moment may get an error, and a loss of power may leave an empty file.
    ///
    /// # Errors
    /// [`IdentityError::File`] when the file cannot be read or created, [`IdentityError::Empty`]
    /// when there is nothing in it, [`IdentityError::Key`] when it holds no key, and
    /// [`IdentityError::Generate`].
    pub fn at(path: impl AsRef<Path>) -> Result<Self, IdentityError> {
        let path = path.as_ref();
        let fail = |source| IdentityError::File { path: path.to_owned(), source };
        if let Some(kept) = Self::kept(path)? {
            return Ok(kept);
        }
        let made = Self::generate()?;
        match create_whole(path, &made.to_pkcs8(), |part, path| fs::hard_link(part, path)) {
            Ok(()) => Ok(made),
            // Another caller was first, or a link that leads nowhere waits at the name.
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                Self::kept(path)?.ok_or_else(|| fail(error))
            }
            Err(error) => Err(fail(error)),
        }
    }

    /// Returns the key in a file, or `None` if there is no file.
    fn kept(path: &Path) -> Result<Option<Self>, IdentityError> {
        match fs::read(path) {
            Ok(der) if der.is_empty() => Err(IdentityError::Empty { path: path.to_owned() }),
            Ok(der) => Self::from_pkcs8(&der).map(Some),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(source) => Err(IdentityError::File { path: path.to_owned(), source }),
        }
    }

    /// Restores an identity from the bytes of [`Identity::to_pkcs8`].
    pub fn from_pkcs8(der: &[u8]) -> Result<Self, IdentityError> {
        let key = KeyPair::from_pkcs8_der_and_sign_algo(&PrivatePkcs8KeyDer::from(der), &PKCS_ED25519)
            .map_err(|error| IdentityError::Key(error.to_string()))?;
        Self::from_key(key)
    }

    /// Returns the private key in PKCS #8 form (DER). Keep it secret: anyone who has it can act as
    /// this user.
    pub fn to_pkcs8(&self) -> Vec<u8> {
        self.key.serialize_der()
    }

    /// Returns the hash of the public key, which an [`Invite`](super::Invite) pins.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    fn from_key(key: KeyPair) -> Result<Self, IdentityError> {
        let certificate = CertificateParams::new(vec![SERVER_NAME.to_owned()])
            .and_then(|params| params.self_signed(&key))
            .map_err(|error| IdentityError::Generate(error.to_string()))?;
        let fingerprint = Fingerprint::of_public_key(&key.subject_public_key_info());
        Ok(Self { certificate: certificate.der().clone(), key, fingerprint })
    }

    pub(super) fn chain(&self) -> (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>) {
        (vec![self.certificate.clone()], PrivatePkcs8KeyDer::from(self.key.serialize_der()).into())
    }
}

/// Creates a file of a secret with all of its bytes, or fails with [`ErrorKind::AlreadyExists`] if
/// anything has its name. Nothing is followed or replaced. `link` makes a hard link.
fn create_whole(
    path: &Path,
    secret: &[u8],
    link: impl FnOnce(&Path, &Path) -> io::Result<()>,
) -> io::Result<()> {
    let name = path.file_name().ok_or(ErrorKind::InvalidFilename)?;
    let (file, part) = new_part(path, name)?;
    // A rename would replace the key of a faster process, and a link does not.
    let created = write_synced(file, secret).and_then(|()| match link(&part, path) {
        // Some file systems have no hard links, and each system has another error for that.
        Err(error) if error.kind() != ErrorKind::AlreadyExists => {
            create_private(path).and_then(|file| {
                write_synced(file, secret).inspect_err(|_| {
                    // The first error is the one to report.
                    let _ = fs::remove_file(path);
                })
            })
        }
        linked => linked,
    });
    // The key has its name or is not wanted. A part that stays behind is its owner's only.
    let _ = fs::remove_file(&part);
    created?;
    // Not every file system syncs folders, and the file is there in any case.
    #[cfg(unix)]
    if let Some(folder) = path.parent() {
        // The folder of a bare name is the working directory.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let _ = File::open(folder).and_then(|folder| folder.sync_all());
    }
    Ok(())
}

fn write_synced(mut file: File, bytes: &[u8]) -> io::Result<()> {
    file.write_all(bytes).and_then(|()| file.sync_all())
}

/// Creates a file that did not exist before, for its owner only.
fn create_private(path: &Path) -> io::Result<File> {
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)
}

/// Creates a temporary file beside `goal` that did not exist before.
fn new_part(goal: &Path, name: &OsStr) -> io::Result<(File, PathBuf)> {
    /// Most names that are tried, because files of killed writers may have them.
    const MAX: usize = 1000;
    // Threads that create the same file write separate temporary files.
    static PARTS: AtomicU64 = AtomicU64::new(0);
    for _ in 0..MAX {
        let number = PARTS.fetch_add(1, Ordering::Relaxed);
        let mut part = name.to_owned();
        part.push(format!(".{}.{number}.part", std::process::id()));
        let part = goal.with_file_name(part);
        match create_private(&part) {
            Ok(file) => return Ok((file, part)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    // Not `AlreadyExists`, which says that the goal exists.
    Err(io::Error::other("a thousand temporary files of killed programs wait beside it"))
}

/// The name in every certificate and handshake. Trust comes from the pinned key, not from a name.
pub(super) const SERVER_NAME: &str = "pliant";

/// Checks that the host's key is the one in the invite, and checks its signature over the
/// handshake.
#[derive(Debug)]
pub(super) struct PinnedHost {
    pub(super) pinned: Fingerprint,
    /// The key that the host presented, if it was another one. The error message contains it.
    pub(super) refused: Arc<Mutex<Option<Fingerprint>>>,
    pub(super) algorithms: WebPkiSupportedAlgorithms,
}

impl PinnedHost {
    pub(super) fn new(pinned: Fingerprint, provider: &CryptoProvider) -> Self {
        Self { pinned, refused: Arc::default(), algorithms: provider.signature_verification_algorithms }
    }
}

impl ServerCertVerifier for PinnedHost {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, TlsError> {
        let found = Fingerprint::of_certificate(end_entity)?;
        if found == self.pinned {
            return Ok(ServerCertVerified::assertion());
        }
        *self.refused.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        Err(TlsError::InvalidCertificate(CertificateError::ApplicationVerificationFailure))
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls12_signature(message, certificate, signature, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
    }
}

/// Accepts any guest that proves that it owns the key it presents. The token determines who may
/// join, and the key identifies the guest permanently.
#[derive(Debug)]
pub(super) struct AnyGuest {
    pub(super) algorithms: WebPkiSupportedAlgorithms,
}

impl ClientCertVerifier for AnyGuest {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, TlsError> {
        Fingerprint::of_certificate(end_entity).map(|_| ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls12_signature(message, certificate, signature, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_survives_being_kept() {
        let identity = Identity::generate().unwrap();
        let again = Identity::from_pkcs8(&identity.to_pkcs8()).unwrap();
        assert_eq!(identity.fingerprint(), again.fingerprint());
        assert_ne!(identity.fingerprint(), Identity::generate().unwrap().fingerprint());
        assert!(matches!(Identity::from_pkcs8(b"not a key"), Err(IdentityError::Key(_))));
    }

    #[test]
    fn a_key_in_a_file_is_its_owners_only() {
        let folder = std::env::temp_dir().join(format!("pliant_net-key-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("key");
        let made = Identity::at(&path).unwrap();
        assert_eq!(Identity::at(&path).unwrap().fingerprint(), made.fingerprint());
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600);
            // A link that waits for the key is not followed, or the key would be in another's file.
            let (link, other) = (folder.join("link"), folder.join("other"));
            std::os::unix::fs::symlink(&other, &link).unwrap();
            assert!(matches!(Identity::at(&link), Err(IdentityError::File { .. })));
            assert!(!other.exists());
        }
        std::fs::write(&path, "no key").unwrap();
        assert!(matches!(Identity::at(&path), Err(IdentityError::Key(_))));
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn a_file_of_a_key_is_its_owners_only_from_the_first_moment() {
        use std::os::unix::fs::PermissionsExt;
        use std::sync::atomic::AtomicBool;
        let path = std::env::temp_dir().join(format!("pliant_net-moment-{}", std::process::id()));
        let (looks, done) = (AtomicU64::new(0), AtomicBool::new(false));
        // One creates the file again and again, and the other looks at it all the time.
        let modes = std::thread::scope(|scope| {
            let look = scope.spawn(|| {
                let mut modes = std::collections::BTreeSet::new();
                while !done.load(Ordering::Acquire) {
                    if let Ok(seen) = path.metadata() {
                        modes.insert(seen.permissions().mode() & 0o777);
                        looks.fetch_add(1, Ordering::AcqRel);
                    }
                }
                modes
            });
            while looks.load(Ordering::Acquire) < 5000 {
                drop(create_private(&path).unwrap());
                fs::remove_file(&path).unwrap();
            }
            done.store(true, Ordering::Release);
            look.join().unwrap()
        });
        assert_eq!(modes.into_iter().collect::<Vec<_>>(), [0o600]);
    }

    #[test]
    fn all_who_make_a_key_at_the_same_moment_get_the_same_key() {
        let folder = std::env::temp_dir().join(format!("pliant_net-race-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let threads = 4;
        for round in 0..50 {
            let path = folder.join(format!("key-{round}"));
            let begin = std::sync::Barrier::new(threads);
            let made: Vec<_> = std::thread::scope(|scope| {
                let make = || {
                    begin.wait();
                    Identity::at(&path).map(|made| made.fingerprint())
                };
                let made: Vec<_> = (0..threads).map(|_| scope.spawn(make)).collect();
                made.into_iter().map(|made| made.join().unwrap()).collect()
            });
            let kept = Identity::at(&path).unwrap().fingerprint();
            assert!(made.iter().all(|made| made.as_ref().ok() == Some(&kept)), "round {round}: {made:?}");
        }
        // The temporary files are gone, and every key is its owner's only.
        let kept: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap()).collect();
        assert_eq!(kept.len(), 50, "{kept:?}");
        #[cfg(unix)]
        for entry in &kept {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(entry.metadata().unwrap().permissions().mode() & 0o777, 0o600);
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_key_is_kept_also_where_there_are_no_hard_links() {
        let folder = std::env::temp_dir().join(format!("pliant_net-no-links-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("key");
        let made = Identity::generate().unwrap();
        let create =
            || create_whole(&path, &made.to_pkcs8(), |_, _| Err(io::Error::from(ErrorKind::Unsupported)));
        create().unwrap();
        assert_eq!(Identity::at(&path).unwrap().fingerprint(), made.fingerprint());
        assert_eq!(create().unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600);
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn an_empty_file_of_a_key_is_told_with_its_remedy() {
        let folder = std::env::temp_dir().join(format!("pliant_net-empty-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("key");
        File::create(&path).unwrap();
        let error = Identity::at(&path).unwrap_err().to_string();
        assert!(error.contains("the file is empty; delete it"), "{error}");
        // Whoever wrote it may still be at work, so that it is not replaced.
        assert_eq!(path.metadata().unwrap().len(), 0);
        std::fs::remove_file(&path).unwrap();
        let made = Identity::at(&path).unwrap();
        assert_eq!(Identity::at(&path).unwrap().fingerprint(), made.fingerprint());
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn the_fingerprint_is_the_hash_of_the_certificates_public_key() {
        let identity = Identity::generate().unwrap();
        assert_eq!(Fingerprint::of_certificate(&identity.certificate).unwrap(), identity.fingerprint());
        // In RFC 8410, an Ed25519 SubjectPublicKeyInfo is these 12 bytes and the 32 bytes of the
        // key.
        let mut spki = vec![0x30, 0x2a, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x03, 0x21, 0x00];
        spki.extend_from_slice(identity.key.public_key_raw());
        assert_eq!(Fingerprint::of_public_key(&spki), identity.fingerprint());
    }

    #[test]
    fn fingerprints_are_written_and_read() {
        let fingerprint = Fingerprint(std::array::from_fn(|i| i as u8 * 7));
        assert_eq!(fingerprint.to_string().parse::<Fingerprint>().unwrap(), fingerprint);
        for wrong in ["", "00", &"g".repeat(64), &"é".repeat(32), &"0".repeat(65)] {
            assert!(wrong.parse::<Fingerprint>().is_err(), "{wrong}");
        }
        let message = "x".repeat(1000).parse::<Fingerprint>().unwrap_err().to_string();
        assert!(message.len() < 200, "{message}");
    }
}
