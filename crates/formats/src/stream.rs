//! Streams of bytes from plain and compressed files.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::bufread::{DeflateDecoder, GzDecoder, ZlibDecoder};

use crate::collector::Collector;
use crate::error::{FormatError, io_error, shown};
use crate::source::file_name;
use crate::warning::WarningKind;

/// The compression of a part of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    Plain,
    Gzip,
    Zlib,
    Deflate,
}

/// A part of a file, decompressed.
pub(crate) struct Unpacked {
    stream: Box<dyn Stream>,
    packing: Packing,
    /// Upper limit of the decompressed bytes.
    most: u64,
}

impl Unpacked {
    /// Opens `length` bytes of `file` from byte `offset`, or the rest of it. `path` is for messages.
    pub(crate) fn open(
        mut file: File,
        path: &Path,
        offset: u64,
        length: Option<u64>,
        packing: Packing,
    ) -> Result<Self, FormatError> {
        let io = io_error(path);
        let rest = file.metadata().map_err(&io)?.len().saturating_sub(offset);
        let length = length.unwrap_or(rest).min(rest);
        if rest > 0 {
            file.seek(SeekFrom::Start(offset)).map_err(&io)?;
        }
        let reader = BufReader::new(file);
        let most = if packing == Packing::Plain { length } else { length.saturating_mul(MAX_DEFLATE_RATIO) };
        let stream: Box<dyn Stream> = match packing {
            Packing::Plain => Box::new(reader),
            Packing::Gzip => Box::new(GzipMembers::new(reader.take(length))),
            Packing::Zlib => Box::new(ZlibDecoder::new(reader.take(length))),
            Packing::Deflate => Box::new(DeflateDecoder::new(reader.take(length))),
        };
        Ok(Self { stream, packing, most })
    }

    /// Skips `skip` bytes and passes the next `num_bytes` bytes to `collector`. The checksum at the end is verified,
    /// and further data cause a warning.
    pub(crate) fn take(
        self,
        collector: &mut Collector,
        path: &Path,
        skip: u64,
        num_bytes: u64,
    ) -> Result<(), FormatError> {
        if self.take_some(collector, path, skip, num_bytes)? {
            warn_of_more(collector, path);
        }
        Ok(())
    }

    /// The same without a warning. Returns whether there are further data.
    pub(crate) fn take_some(
        mut self,
        collector: &mut Collector,
        path: &Path,
        skip: u64,
        num_bytes: u64,
    ) -> Result<bool, FormatError> {
        collector.check_length(path, num_bytes, self.most.saturating_sub(skip))?;
        let damaged = |e: io::Error| {
            let problem = format!("compressed data is damaged or cut: {e}");
            FormatError::Data { path: shown(path), problem }
        };
        self.stream.pass(skip).map_err(damaged)?;
        let before = collector.position();
        collector.pump(&mut self.stream, path, num_bytes)?;
        let is_all = collector.position() - before == num_bytes / collector.bytes_per_number();
        Ok(match self.packing {
            Packing::Plain => self.most > num_bytes + skip,
            _ => is_all && self.stream.read(&mut [0]).map_err(damaged)? > 0,
        })
    }
}

/// Warns that the file at `path` continues after the last voxel.
pub(crate) fn warn_of_more(collector: &mut Collector, path: &Path) {
    let text = format!("{} has more data than its shape needs; the rest is ignored", file_name(path));
    collector.warn(WarningKind::Data, text);
}

impl Unpacked {
    /// The first `num_bytes` bytes.
    pub(crate) fn take_start(self, num_bytes: u64) -> impl Read {
        self.stream.take(num_bytes)
    }
}

impl Read for Unpacked {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        self.stream.read(out)
    }
}

/// A stream that can skip bytes.
pub(crate) trait Stream: Read {
    /// Skips `num_bytes` bytes, or the rest.
    fn pass(&mut self, num_bytes: u64) -> io::Result<()>;
}

impl<R: Read + Seek> Stream for BufReader<R> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        match i64::try_from(num_bytes) {
            Ok(n) => self.seek_relative(n),
            Err(_) => Err(io::ErrorKind::UnexpectedEof.into()),
        }
    }
}

impl<R: BufRead> Stream for GzipMembers<R> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        read_past(self, num_bytes)
    }
}

impl<R: BufRead> Stream for ZlibDecoder<R> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        read_past(self, num_bytes)
    }
}

impl<R: BufRead> Stream for DeflateDecoder<R> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        read_past(self, num_bytes)
    }
}

impl Stream for Box<dyn Stream> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        (**self).pass(num_bytes)
    }
}

impl Stream for &[u8] {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        *self = self.get(usize::try_from(num_bytes).unwrap_or(usize::MAX)..).unwrap_or_default();
        Ok(())
    }
}

/// Skips bytes by reading them.
pub(crate) fn read_past(reader: &mut dyn Read, num_bytes: u64) -> io::Result<()> {
    io::copy(&mut reader.take(num_bytes), &mut io::sink()).map(drop)
}

/// The members of a gzip file, one after the other. Other data after them are ignored, as in other readers.
struct GzipMembers<R> {
    member: Option<GzDecoder<R>>,
}

impl<R: BufRead> GzipMembers<R> {
    fn new(reader: R) -> Self {
        Self { member: Some(GzDecoder::new(reader)) }
    }
}

impl<R: BufRead> Read for GzipMembers<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while let Some(member) = &mut self.member {
            let n = member.read(out)?;
            if n > 0 || out.is_empty() {
                return Ok(n);
            }
            let mut rest = self.member.take().expect("the loop holds a member").into_inner();
            if matches!(rest.fill_buf()?, [0x1f] | [0x1f, 0x8b, ..]) {
                self.member = Some(GzDecoder::new(rest));
            }
        }
        Ok(0)
    }
}

/// Greatest ratio of deflate, which packs at most 258 bytes into two bits (RFC 1951).
pub(crate) const MAX_DEFLATE_RATIO: u64 = 1032;
