//! `sightfix tls`

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, Subcommand};
use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Span, Timestamp};
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, date_time_ymd,
};

use super::output::{print_line, print_note};
use crate::clock::Clock;
use crate::exchange::bracketed;

/// The port of the commands that are printed.
const PORT: u16 = 8443;

/// Make the certificate that browsers on phones need, without a name of one's own
#[derive(Args)]
pub(super) struct Tls {
    #[command(subcommand)]
    command: TlsCommand,
}

#[derive(Subcommand)]
enum TlsCommand {
    /// Write a certificate for this server, and the authority that phones must trust
    SelfSigned(SelfSigned),
}

#[derive(Args)]
struct SelfSigned {
    /// Address or name by which phones reach the server, such as 192.0.2.7; repeat it for more
    #[arg(long = "host", value_name = "HOST", required = true)]
    hosts: Vec<String>,
    /// Folder for authority.pem, certificate.pem and key.pem, which must not exist there
    #[arg(long, value_name = "DIR", default_value = "tls")]
    out: PathBuf,
    /// Days until the certificate expires; phones refuse more than 825
    #[arg(long, value_name = "N", default_value_t = 397, value_parser = clap::value_parser!(u16).range(1..=825))]
    days: u16,
}

/// The texts (PEM) of the three files.
struct Issued {
    authority: String,
    certificate: String,
    key: String,
}

impl Tls {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.command {
            TlsCommand::SelfSigned(command) => command.run(),
        }
    }
}

impl SelfSigned {
    fn run(self) -> anyhow::Result<()> {
        let issued = self.issue(Clock::system().now())?;
        std::fs::create_dir_all(&self.out)
            .with_context(|| format!("cannot create {}", self.out.display()))?;
        let [authority, certificate, key] =
            ["authority.pem", "certificate.pem", "key.pem"].map(|name| self.out.join(name));
        write_new(&key, &issued.key)?;
        write_new(&certificate, &issued.certificate)?;
        write_new(&authority, &issued.authority)?;
        self.print_next_steps(&authority, &certificate, &key)
    }

    /// An authority and a certificate that it has signed. The authority's key is forgotten, so that nobody can sign
    /// another certificate that the phones would trust.
    fn issue(&self, now: Timestamp) -> anyhow::Result<Issued> {
        let mut authority = CertificateParams::default();
        authority.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        authority.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        authority.distinguished_name.push(DnType::CommonName, format!("sightfix at {}", self.hosts[0]));
        self.limit(&mut authority, now)?;
        let authority_key = KeyPair::generate()?;
        let authority_certificate = authority.self_signed(&authority_key)?;

        let mut server = CertificateParams::new(self.hosts.clone())
            .with_context(|| format!("{} is neither an address nor a name", self.hosts.join(", ")))?;
        server.distinguished_name.push(DnType::CommonName, self.hosts[0].clone());
        server.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        server.use_authority_key_identifier_extension = true;
        self.limit(&mut server, now)?;
        let key = KeyPair::generate()?;
        let certificate = server.signed_by(&key, &Issuer::new(authority, authority_key))?;
        Ok(Issued {
            authority: authority_certificate.pem(),
            certificate: certificate.pem(),
            key: key.serialize_pem(),
        })
    }

    /// Limits a certificate in time: from yesterday, since clocks of phones differ.
    fn limit(&self, params: &mut CertificateParams, now: Timestamp) -> anyhow::Result<()> {
        let today = now.to_zoned(TimeZone::UTC).date();
        let midnight = |date: Date| -> anyhow::Result<_> {
            Ok(date_time_ymd(date.year().into(), u8::try_from(date.month())?, u8::try_from(date.day())?))
        };
        params.not_before = midnight(today.yesterday()?)?;
        params.not_after = midnight(today.checked_add(Span::new().days(i64::from(self.days) - 1))?)?;
        Ok(())
    }

    fn print_next_steps(&self, authority: &Path, certificate: &Path, key: &Path) -> anyhow::Result<()> {
        let host = bracketed(&self.hosts[0]);
        let address = format!("https://{host}:{PORT}/authority.crt");
        print_note("1. serve:");
        print_line(&format_args!(
            "SIGHTFIX_CONSOLE__AUTHORITY={} sightfix serve --listen 0.0.0.0:{PORT} --tls-cert {} --tls-key {}",
            authority.display(),
            certificate.display(),
            key.display()
        ))?;
        print_note(format_args!(
            "2. open {address} on the phone, accept the warning this once, and install the authority"
        ));
        // Light on dark, as most terminals are.
        let code = QrCode::new(&address).context("the address is too long for a QR code")?;
        print_note(code.render().dark_color(Dense1x2::Light).light_color(Dense1x2::Dark).build());
        print_note(format_args!("3. open https://{host}:{PORT}/walk"));
        Ok(())
    }
}

/// Writes a file that only its owner may read.
fn write_new(path: &Path, text: &str) -> anyhow::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let write = |mut file: File| file.write_all(text.as_bytes()).and_then(|()| file.sync_all());
    options.open(path).and_then(write).with_context(|| format!("cannot write {}", path.display()))
}
