//! The invite: the line that a host prints and a guest pastes.

use std::fmt;
use std::net::{Ipv6Addr, SocketAddr};
use std::str::FromStr;

use ring::rand::{SecureRandom, SystemRandom};
use thiserror::Error;

use super::identity::{Fingerprint, parse_hex, write_hex};

/// A secret of 16 random bytes that a guest presents to be admitted, written as 32 hexadecimal
/// digits.
#[derive(Clone, Copy)]
pub struct Token(pub [u8; 16]);

impl Token {
    /// Creates a token from the system's random source.
    pub fn generate() -> Result<Self, InviteError> {
        let mut bytes = [0; 16];
        SystemRandom::new().fill(&mut bytes).map_err(|_| InviteError::NoRandomness)?;
        Ok(Self(bytes))
    }
}

impl PartialEq for Token {
    /// Takes the same time wherever the two differ, so that timing reveals nothing about the token.
    fn eq(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
    }
}

impl Eq for Token {}

impl fmt::Debug for Token {
    /// Formats the token without the secret, because tokens must not reach the log.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// The address of a host, the key that it must present, and the token that it asks for. Written as
/// `pliant://host:port#fingerprint` or, with a token, `pliant://host:port/token#fingerprint`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Invite {
    /// Name or address of the host, without brackets.
    pub host: String,
    /// UDP port.
    pub port: u16,
    /// Fingerprint of the host's key.
    pub fingerprint: Fingerprint,
    /// The token that the host asks for. `None` if the host admits anyone.
    pub token: Option<Token>,
}

impl Invite {
    /// Creates an invite, without a token, to the host at `address` with the key `fingerprint`.
    pub fn new(address: SocketAddr, fingerprint: Fingerprint) -> Self {
        Self { host: address.ip().to_string(), port: address.port(), fingerprint, token: None }
    }

    /// Returns the invite with a token.
    pub fn with_token(mut self, token: Token) -> Self {
        self.token = Some(token);
        self
    }
}

impl fmt::Display for Invite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(SCHEME)?;
        match self.host.parse::<Ipv6Addr>() {
            Ok(address) => write!(f, "[{address}]")?,
            Err(_) => f.write_str(&self.host)?,
        }
        write!(f, ":{}", self.port)?;
        if let Some(token) = self.token {
            f.write_str("/")?;
            write_hex(f, &token.0)?;
        }
        write!(f, "#{}", self.fingerprint)
    }
}

impl FromStr for Invite {
    type Err = InviteError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let text = text.trim();
        let wrong = |expected| InviteError::Malformed { expected, found: described(text) };
        let rest = text.strip_prefix(SCHEME).ok_or_else(|| wrong("`pliant://` at the start"))?;
        let (place, fingerprint) =
            rest.rsplit_once('#').ok_or_else(|| wrong("`#` and the host's fingerprint"))?;
        let fingerprint = parse_hex(fingerprint)
            .map(Fingerprint)
            .ok_or_else(|| wrong("64 hexadecimal digits after `#`"))?;
        let (address, token) = match place.split_once('/') {
            None => (place, None),
            Some((address, token)) => {
                let token =
                    parse_hex(token).ok_or_else(|| wrong("a token of 32 hexadecimal digits after `/`"))?;
                (address, Some(Token(token)))
            }
        };
        let (host, port) = address.rsplit_once(':').ok_or_else(|| wrong("`host:port`"))?;
        let port =
            port.parse().ok().filter(|&port| port != 0).ok_or_else(|| wrong("a port from 1 to 65535"))?;
        let host = match host.strip_prefix('[') {
            None => host,
            Some(bracketed) => bracketed
                .strip_suffix(']')
                .filter(|inner| inner.parse::<Ipv6Addr>().is_ok())
                .ok_or_else(|| wrong("an IPv6 address between the brackets"))?,
        };
        let printable = !host.is_empty() && host.len() <= 253 && host.chars().all(|c| c.is_ascii_graphic());
        if !printable {
            return Err(wrong("a host name or address"));
        }
        // One spelling of an address, so that invites that mean the same are equal.
        let host = host.parse::<Ipv6Addr>().map_or_else(|_| host.to_owned(), |address| address.to_string());
        Ok(Self { host, port, fingerprint, token })
    }
}

impl TryFrom<&str> for Invite {
    type Error = InviteError;

    fn try_from(text: &str) -> Result<Self, Self::Error> {
        text.parse()
    }
}

const SCHEME: &str = "pliant://";

/// Describes a text that is no invite, without any of it. A mistyped invite still has its token,
/// and errors reach logs and screens.
fn described(text: &str) -> String {
    let begins = if text.starts_with(SCHEME) { "" } else { "do not " };
    format!("{} bytes that {begins}begin with `{SCHEME}`", text.len())
}

/// Why an invite could not be read or made.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum InviteError {
    /// The text is not an invite.
    #[error("not an invite: expected {expected}, as in `pliant://host:port#fingerprint`, found {found}")]
    Malformed {
        /// The part that is missing or wrong.
        expected: &'static str,
        /// What was found instead, described without the text itself, which may hold a token.
        found: String,
    },
    /// The system's random source failed.
    #[error("the system's random source failed")]
    NoRandomness,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invites_are_written_and_read() {
        let fingerprint = Fingerprint([0xab; 32]);
        for (address, text) in [("192.0.2.7:4433", "192.0.2.7:4433"), ("[2001:db8::1]:9", "[2001:db8::1]:9")]
        {
            let invite = Invite::new(address.parse().unwrap(), fingerprint);
            assert_eq!(invite.to_string(), format!("pliant://{text}#{}", "ab".repeat(32)));
            assert_eq!(invite.to_string().parse::<Invite>().unwrap(), invite);
            let invite = invite.with_token(Token([0x0c; 16]));
            assert_eq!(
                invite.to_string(),
                format!("pliant://{text}/{}#{}", "0c".repeat(16), "ab".repeat(32))
            );
            assert_eq!(invite.to_string().parse::<Invite>().unwrap(), invite);
        }
        let named: Invite = format!(" pliant://play.example.org:4433#{fingerprint}\n").parse().unwrap();
        assert_eq!((named.host.as_str(), named.port), ("play.example.org", 4433));
    }

    #[test]
    fn what_is_no_invite_is_refused_with_what_was_expected() {
        let key = "ab".repeat(32);
        for (text, expected) in [
            (String::new(), "pliant://"),
            (format!("https://host:1#{key}"), "pliant://"),
            ("pliant://host:1".into(), "fingerprint"),
            (format!("pliant://host:1#{}", &key[1..]), "64 hexadecimal digits"),
            (format!("pliant://host#{key}"), "host:port"),
            (format!("pliant://host:0#{key}"), "a port"),
            (format!("pliant://host:65536#{key}"), "a port"),
            (format!("pliant://:1#{key}"), "a host name"),
            (format!("pliant://a b:1#{key}"), "a host name"),
            (format!("pliant://[::1:1#{key}"), "brackets"),
            (format!("pliant://host:1/abc#{key}"), "a token"),
        ] {
            let error = text.parse::<Invite>().unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn no_error_repeats_an_invite() {
        let (token, key) = ("0c".repeat(16), "ab".repeat(32));
        for text in [
            format!("pliant://play.example.org:0/{token}#{key}"),
            format!("pliant:/play.example.org:4433/{token}#{key}"),
            format!("pliant://play.example.org:4433/{token}#{}", &key[1..]),
            format!("pliant://play.example.org:4433/{token}0#{key}"),
            format!("pliant://play.example.org:4433/{token}"),
            format!("see {token}"),
        ] {
            let error = text.parse::<Invite>().unwrap_err();
            for shown in [error.to_string(), format!("{error:?}")] {
                assert!(!shown.contains(&token[..8]), "{shown}");
                assert!(!shown.contains("example.org"), "{shown}");
            }
        }
        let invite = Invite::new("192.0.2.7:4433".parse().unwrap(), Fingerprint([0xab; 32]));
        let invite = invite.with_token(Token([0x0c; 16]));
        assert!(!format!("{invite:?}").contains(&token[..8]), "{invite:?}");
    }

    #[test]
    fn tokens_differ_and_do_not_show() {
        let (a, b) = (Token::generate().unwrap(), Token::generate().unwrap());
        assert_ne!(a, b);
        assert_eq!(format!("{a:?}"), "Token(…)");
    }
}
