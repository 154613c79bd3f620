//! A serial device that is read, such as a GNSS or AIS receiver on a USB adapter.

use std::os::unix::fs::FileTypeExt as _;

use rustix::fs::{Mode, OFlags};
use rustix::termios::{ControlModes, OptionalActions, tcgetattr, tcsetattr};
use tokio::net::unix::pipe::Receiver;

use crate::connect::credentials::PeerError;
use crate::exchange::kinds::SerialLine;

/// Opens a terminal device for reading: 8 data bits, no parity, no flow control, nothing is translated.
pub(super) fn open(line: &SerialLine) -> Result<Receiver, PeerError> {
    let path = line.path.display();
    // Opening other devices may have effects, and opening a named pipe waits.
    let found = std::fs::metadata(&line.path).map_err(|error| PeerError(format!("{path}: {error}")))?;
    if !found.file_type().is_char_device() {
        return Err(PeerError(format!("{path} is no serial device")));
    }
    let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let device = rustix::fs::open(&line.path, flags, Mode::empty()).map_err(std::io::Error::from)?;
    let mut settings = tcgetattr(&device).map_err(|_| PeerError(format!("{path} is no serial device")))?;
    settings.make_raw();
    settings.control_modes.remove(ControlModes::CSTOPB | ControlModes::CRTSCTS);
    // Without CLOCAL a line without a modem's carrier would not be read.
    settings.control_modes.insert(ControlModes::CREAD | ControlModes::CLOCAL);
    let unusable =
        |error: std::io::Error| PeerError(format!("{path} cannot have {} baud: {error}", line.baud));
    settings.set_speed(line.baud).map_err(|error| unusable(error.into()))?;
    tcsetattr(&device, OptionalActions::Now, &settings).map_err(|error| unusable(error.into()))?;
    // A reader of any descriptor that can be polled.
    Ok(Receiver::from_owned_fd_unchecked(device)?)
}
