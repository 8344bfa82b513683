//! Movies of pictures that come one after the other: animated GIF, and APNG in all colours.
//!
//! A movie is written beside its place and moved there at the end. So it is there whole or not at all.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::NamedTempFile;

use crate::error::{FormatError, io_error};
use crate::output::{Readers, file_beside, folder_of, remove_leftovers, resolved};
use crate::png::Rgb8;

/// The form of a movie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MovieForm {
    /// Animated GIF: every program shows it, with 256 colours a picture.
    Gif,
    /// Animated PNG: all colours, and browsers show it.
    Apng,
}

impl MovieForm {
    /// The form that the ending of a file's name asks for; none if it is no movie.
    pub fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_lowercase().as_str() {
            "gif" => Some(Self::Gif),
            "apng" => Some(Self::Apng),
            _ => None,
        }
    }

    /// The ending of its file's name.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Gif => "gif",
            Self::Apng => "apng",
        }
    }
}

/// A movie that is being written. Dropping it leaves no file. What a killed program leaves goes with the next movie.
pub struct MovieWriter {
    path: PathBuf,
    file: NamedTempFile<File>,
    encoder: MovieEncoder,
    size: [u32; 2],
    left: u32,
    interval: Duration,
}

enum MovieEncoder {
    Gif(gif::Encoder<BufWriter<File>>),
    Apng(png::Writer<File>),
}

impl MovieWriter {
    /// Begins a movie of `num_pictures` of this size, in pixels, with so much time from one to the next: [`INTERVAL`]
    /// for a camera that moves, [`interval_of_times`] for times. It plays without end.
    ///
    /// # Errors
    /// The folder takes no file, or the size is too large for the form.
    pub fn create(
        path: &Path,
        form: MovieForm,
        size: [u32; 2],
        num_pictures: u32,
        interval: Duration,
    ) -> Result<Self, FormatError> {
        let failed = io_error(path);
        let path = &resolved(path);
        remove_leftovers(folder_of(path));
        let Some(file) = file_beside(path, Readers::OfUmask).map_err(&failed)? else {
            return Err(failed(io::Error::other("a movie needs a file of its own")));
        };
        let encoder = begin(&file, form, size, num_pictures, interval).map_err(&failed)?;
        Ok(Self { path: path.to_owned(), file, encoder, size, left: num_pictures, interval })
    }

    /// Adds the next picture.
    ///
    /// # Errors
    /// It has another size, is one too many, or cannot be written.
    pub fn add(&mut self, picture: &Rgb8) -> Result<(), FormatError> {
        let (size, is_whole) = ([picture.width, picture.height], self.left > 0);
        let is_fitting = is_whole && size == self.size && picture.bytes.len() == num_bytes(size);
        let added = match is_fitting {
            true => self.encode(picture),
            false => Err(io::Error::other("a picture has another size, or is one too many")),
        };
        self.left = self.left.saturating_sub(1);
        added.map_err(io_error(&self.path))
    }

    /// Puts the movie in its place. A file that is there is replaced only if `replaces`.
    ///
    /// # Errors
    /// Pictures are missing, the system refuses, or there is a file that is not to be replaced.
    pub fn finish(self, replaces: bool) -> Result<(), FormatError> {
        let failed = io_error(&self.path);
        if self.left > 0 {
            return Err(failed(io::Error::other(format!("{} pictures are missing", self.left))));
        }
        let ended = match self.encoder {
            MovieEncoder::Gif(encoder) => {
                let buffer = encoder.into_inner().map_err(io::Error::other);
                buffer.and_then(|buffer| buffer.into_inner().map(drop).map_err(io::Error::from))
            }
            MovieEncoder::Apng(encoder) => encoder.finish().map_err(io::Error::from),
        };
        ended.and_then(|()| self.file.as_file().sync_all()).map_err(&failed)?;
        let kept = match replaces {
            true => self.file.persist(&self.path),
            false => self.file.persist_noclobber(&self.path),
        };
        kept.map(drop).map_err(|e| failed(e.error))
    }

    fn encode(&mut self, picture: &Rgb8) -> io::Result<()> {
        match &mut self.encoder {
            MovieEncoder::Gif(encoder) => {
                let [width, height] = self.size.map(|side| side as u16);
                let mut frame = gif::Frame::from_rgb_speed(width, height, &picture.bytes, GIF_SPEED);
                // In hundredths of a second. Programs show a shorter one slowly.
                frame.delay = (self.interval.as_millis() / 10).clamp(2, u16::MAX.into()) as u16;
                encoder.write_frame(&frame).map_err(io::Error::other)
            }
            MovieEncoder::Apng(encoder) => encoder.write_image_data(&picture.bytes).map_err(io::Error::from),
        }
    }
}

fn begin(
    file: &NamedTempFile<File>,
    form: MovieForm,
    size: [u32; 2],
    num_pictures: u32,
    interval: Duration,
) -> io::Result<MovieEncoder> {
    let [width, height] = size;
    let file = file.as_file().try_clone()?;
    let short = |side: u32| u16::try_from(side).map_err(|_| io::Error::other("a side is too long for a GIF"));
    match form {
        MovieForm::Gif => {
            let buffer = BufWriter::new(file);
            let encoder = gif::Encoder::new(buffer, short(width)?, short(height)?, &[]);
            let mut encoder = encoder.map_err(io::Error::other)?;
            encoder.set_repeat(gif::Repeat::Infinite).map_err(io::Error::other)?;
            Ok(MovieEncoder::Gif(encoder))
        }
        MovieForm::Apng => {
            let mut encoder = png::Encoder::new(file, width, height);
            encoder.set_color(png::ColorType::Rgb);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_animated(num_pictures, 0)?;
            encoder.set_frame_delay(interval.as_millis().min(u16::MAX.into()) as u16, 1000)?;
            Ok(MovieEncoder::Apng(encoder.write_header()?))
        }
    }
}

fn num_bytes([width, height]: [u32; 2]) -> usize {
    3 * width as usize * height as usize
}

/// The time from one point in time of a file to the next while they are played: `time_step` seconds, as in the file,
/// unless it tells none or nobody would wait so long.
pub fn interval_of_times(time_step: Option<f64>) -> Duration {
    let own = time_step.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    own.filter(|own| (Duration::from_nanos(1)..=LONGEST_INTERVAL).contains(own)).unwrap_or(USUAL_INTERVAL)
}

/// The speed of a movie. A GIF counts in hundredths of a second, so this divides 100.
pub const PICTURES_PER_SECOND: u32 = 25;
/// The time from one picture to the next at that speed.
pub const INTERVAL: Duration = Duration::from_millis(1000 / PICTURES_PER_SECOND as u64);
/// The interval of times that a file tells none of: five a second.
const USUAL_INTERVAL: Duration = Duration::from_millis(200);
/// Longer intervals are those of a film in time lapse.
const LONGEST_INTERVAL: Duration = Duration::from_secs(5);
/// From 1, the best colours, to 30, the fastest.
const GIF_SPEED: i32 = 10;

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(number: u32) -> Rgb8 {
        let bytes = (0..12 * 8).flat_map(|i| [(i * 2 + number * 40) as u8, number as u8 * 50, 200]).collect();
        Rgb8 { width: 12, height: 8, bytes }
    }

    fn write(path: &Path, form: MovieForm, number: u32) -> Result<(), FormatError> {
        write_at(path, form, number, INTERVAL)
    }

    fn write_at(path: &Path, form: MovieForm, number: u32, interval: Duration) -> Result<(), FormatError> {
        let mut movie = MovieWriter::create(path, form, [12, 8], number, interval)?;
        (0..number).try_for_each(|i| movie.add(&picture(i)))?;
        movie.finish(false)
    }

    fn files(folder: &Path) -> usize {
        std::fs::read_dir(folder).unwrap().count()
    }

    #[test]
    fn an_apng_reads_back_every_picture() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.apng");
        write(&path, MovieForm::Apng, 4).unwrap();
        let mut reader =
            png::Decoder::new(io::Cursor::new(std::fs::read(&path).unwrap())).read_info().unwrap();
        assert_eq!(reader.info().animation_control().unwrap().num_frames, 4);
        let mut bytes = vec![0; num_bytes([12, 8])];
        for number in 0..4 {
            reader.next_frame(&mut bytes).unwrap();
            assert_eq!(bytes, picture(number).bytes, "{number}");
        }
        let delay = reader.info().frame_control().unwrap();
        assert_eq!((delay.delay_num, delay.delay_den), (40, 1000));
        // It is a picture for programs that know no movies.
        assert_eq!(crate::png::decode(&std::fs::read(&path).unwrap(), 96).unwrap(), picture(0));
    }

    #[test]
    fn a_gif_reads_back_nearly_every_colour() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gif");
        write(&path, MovieForm::Gif, 3).unwrap();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut reader = options.read_info(File::open(&path).unwrap()).unwrap();
        for number in 0..3 {
            let frame = reader.read_next_frame().unwrap().unwrap();
            assert_eq!((frame.delay, frame.width, frame.height), (4, 12, 8));
            let wanted = picture(number).bytes;
            let most = frame.buffer.chunks(4).zip(wanted.chunks(3));
            let most = most.flat_map(|(a, b)| (0..3).map(move |i| a[i].abs_diff(b[i]))).max().unwrap();
            assert!(most <= 16, "{most} of 255");
        }
        assert!(reader.read_next_frame().unwrap().is_none());
        for (milliseconds, hundredths) in [(500, 50), (1, 2), (5000, 500), (10_000_000, u16::MAX)] {
            std::fs::remove_file(&path).unwrap();
            write_at(&path, MovieForm::Gif, 1, Duration::from_millis(milliseconds)).unwrap();
            let options = gif::DecodeOptions::new();
            let mut reader = options.read_info(File::open(&path).unwrap()).unwrap();
            assert_eq!(reader.read_next_frame().unwrap().unwrap().delay, hundredths);
        }
    }

    #[test]
    fn times_play_at_their_interval_and_a_film_in_time_lapse_is_played_faster() {
        for (seconds, milliseconds) in [
            (None, 200),
            (Some(2.0), 2000),
            (Some(0.04), 40),
            (Some(600.0), 200),
            (Some(0.0), 200),
            (Some(-1.0), 200),
            (Some(f64::NAN), 200),
            (Some(1e300), 200),
        ] {
            assert_eq!(interval_of_times(seconds), Duration::from_millis(milliseconds), "{seconds:?}");
        }
    }

    #[test]
    fn a_movie_is_there_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        for form in [MovieForm::Gif, MovieForm::Apng] {
            let path = folder.path().join("a").with_extension(form.extension());
            assert_eq!(MovieForm::of(&path), Some(form));
            let mut movie = MovieWriter::create(&path, form, [12, 8], 3, INTERVAL).unwrap();
            movie.add(&picture(0)).unwrap();
            assert!(movie.finish(true).is_err(), "two are missing");
            let mut movie = MovieWriter::create(&path, form, [12, 8], 1, INTERVAL).unwrap();
            assert!(movie.add(&Rgb8 { width: 11, ..picture(0) }).is_err());
            drop(movie);
            let mut movie = MovieWriter::create(&path, form, [12, 8], 1, INTERVAL).unwrap();
            movie.add(&picture(0)).unwrap();
            assert!(movie.add(&picture(1)).is_err(), "one too many");
            drop(movie);
            assert_eq!(files(folder.path()), 0);
            std::fs::write(&path, "mine").unwrap();
            assert!(write(&path, form, 1).is_err() && files(folder.path()) == 1, "it is not replaced");
            std::fs::remove_file(&path).unwrap();
            write(&path, form, 1).unwrap();
            assert_eq!(files(folder.path()), 1);
            std::fs::remove_file(&path).unwrap();
        }
        assert!(
            MovieWriter::create(&folder.path().join("a.gif"), MovieForm::Gif, [70_000, 8], 1, INTERVAL)
                .is_err()
        );
        assert!(
            MovieWriter::create(folder.path(), MovieForm::Gif, [12, 8], 1, INTERVAL).is_err(),
            "a folder"
        );
        assert_eq!(MovieForm::of(Path::new("a.png")), None);
    }
}
