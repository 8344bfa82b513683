//! Screenshots: one of the view, or a turntable or a recorded path of many, as files or as a movie. The server renders them in full, and
//! they are written here.
//!
//! One picture is requested at a time, the next when the one before is on the disk. A thread writes the files.

mod files;
mod marks;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use egui::{Align2, Context, RichText, vec2};
use glam::{Quat, Vec3};
use isinglass_core::camera::{Intrinsics, MAX_SIDE, Pose};
use isinglass_core::ids::ScreenshotId;
use isinglass_core::space::Aabb;
use isinglass_core::wire::screenshot::MAX_SCREENSHOT_PIXELS;
use isinglass_formats::movie::{INTERVAL, MovieForm, MovieWriter, PICTURES_PER_SECOND};
use isinglass_formats::png;
use isinglass_net::State;
use time::OffsetDateTime;

use self::marks::PictureMarks;

use super::background::Background;
use super::controls::{self, whole};
use super::style::pane_at;
use crate::input::camera_path::CameraPath;
use crate::view::frame_source::FrameSource;
use crate::view::waker_of;

pub(crate) use self::marks::LegendSubject;

#[derive(Clone, Debug)]
pub(crate) struct Subject {
    /// Name of the volume, from which the files get theirs.
    pub(crate) name: String,
    pub(crate) pose: Pose,
    pub(crate) intrinsics: Intrinsics,
    /// sRGB behind the volume.
    pub(crate) background: [u8; 3],
    pub(crate) bounds: Aabb,
    /// The axis of a turntable: a point and a unit vector.
    pub(crate) center: Vec3,
    pub(crate) up: Vec3,
    /// Unit of length, if known.
    pub(crate) unit: Option<String>,
    pub(crate) legend: Option<LegendSubject>,
}

pub(crate) struct Screenshots {
    is_dialog_open: bool,
    size: Option<[u32; 2]>,
    num_pictures: u32,
    /// The way of the camera that was recorded, and whether pictures go along it.
    path: Option<Arc<CameraPath>>,
    takes_path: bool,
    /// The form of several pictures; none for a file each.
    movie: Option<MovieForm>,
    is_transparent: bool,
    has_scale: bool,
    has_legend: bool,
    /// Where files go, as the person writes it.
    pub(crate) folder: String,
    series: Option<Series>,
    saving_path: Background<PathBuf>,
}

struct Series {
    subject: Subject,
    /// The way of the camera; none for a turntable.
    way: Option<Arc<CameraPath>>,
    total: u32,
    done: u32,
    /// The file, or the folder of several.
    path: PathBuf,
    is_transparent: bool,
    marks: Option<PictureMarks>,
    movie: Option<MovieForm>,
    /// The movie between two pictures.
    writer: Option<MovieWriter>,
    stage: PictureStage,
}

/// The stage of the picture after the last that is done.
enum PictureStage {
    Due,
    Requested(ScreenshotId),
    Writing(Background<Stored>),
}

/// What has become of a picture: its file, or the movie that it is in, and where that will be.
enum Stored {
    File(PathBuf),
    InMovie(MovieWriter, PathBuf),
}

/// Removes half movies of windows that were killed. It may wait for the disk.
pub(crate) fn remove_leftovers() {
    isinglass_formats::remove_leftovers(&files::default_folder());
}

impl Default for Screenshots {
    fn default() -> Self {
        let folder = files::default_folder().display().to_string();
        Self {
            is_dialog_open: false,
            size: None,
            num_pictures: 1,
            path: None,
            takes_path: false,
            movie: None,
            is_transparent: false,
            has_scale: false,
            has_legend: false,
            folder,
            series: None,
            saving_path: Background::default(),
        }
    }
}

impl Screenshots {
    #[cfg(test)]
    pub(crate) fn set_for_test(&mut self, name: &str, value: u32) {
        let size = self.size.get_or_insert([1; 2]);
        match name {
            "width" => size[0] = value,
            "height" => size[1] = value,
            _ => self.num_pictures = value,
        }
    }

    pub(crate) fn is_dialog_open(&self) -> bool {
        self.is_dialog_open
    }

    pub(crate) fn toggle_dialog(&mut self) {
        self.is_dialog_open = !self.is_dialog_open;
    }

    /// A path was recorded: its movie is asked for.
    pub(crate) fn offer_path(&mut self, path: Arc<CameraPath>) {
        self.path = Some(path);
        self.open_for_path();
    }

    pub(crate) fn has_path(&self) -> bool {
        self.path.is_some()
    }

    /// Opens the dialog for the movie of the recorded path.
    pub(crate) fn open_for_path(&mut self) {
        self.is_dialog_open = true;
        if !std::mem::replace(&mut self.takes_path, self.path.is_some()) {
            self.movie = self.movie.or(Some(MovieForm::Gif));
        }
    }

    /// The path that pictures go along, if they do.
    fn way(&self) -> Option<&Arc<CameraPath>> {
        self.path.as_ref().filter(|_| self.takes_path)
    }

    pub(crate) fn close_dialog(&mut self) {
        self.is_dialog_open = false;
    }

    /// Requests one picture as large as the window's, unless others are in progress.
    pub(crate) fn take(&mut self, ctx: &Context, subject: Subject) {
        if self.series.is_none() {
            self.begin(ctx, subject, 1, None);
        }
    }

    fn begin(&mut self, ctx: &Context, subject: Subject, total: u32, way: Option<Arc<CameraPath>>) {
        let folder = files::folder_from_text(&self.folder);
        let movie = self.movie.filter(|_| total > 1);
        let end = match (&way, total) {
            (Some(_), _) => "-path",
            (None, 1) => ".png",
            (None, _) => "-turntable",
        };
        let mut path = folder.join(files::file_name(&subject.name, OffsetDateTime::now_utc(), end));
        if let Some(form) = movie {
            path.as_mut_os_string().push(format!(".{}", form.extension()));
        }
        self.series = Some(Series {
            total,
            done: 0,
            path,
            // Movies have no transparency.
            is_transparent: self.is_transparent && movie.is_none(),
            marks: PictureMarks::of(ctx, &subject, self.has_scale, self.has_legend),
            movie,
            writer: None,
            subject,
            way,
            stage: PictureStage::Due,
        });
    }

    /// Continues what is in progress. Returns news for the person. Never waits.
    pub(crate) fn poll(&mut self, source: &mut impl FrameSource, ctx: &Context) -> Option<String> {
        if let Some(saved) = self.saving_path.take() {
            return Some(match saved {
                Ok(file) => format!("Saved {}", file.display()),
                Err(why) => format!("The path is not saved: {why}"),
            });
        }
        let series = self.series.as_mut()?;
        match &mut series.stage {
            PictureStage::Due => {
                let Subject { intrinsics, background, .. } = series.subject;
                let background = (!series.is_transparent).then_some(background);
                let id = source.talk().screenshot.request(series.pose(), intrinsics, background, None);
                series.stage = PictureStage::Requested(id);
                None
            }
            PictureStage::Requested(id) => {
                let shot = source.talk().quietly().screenshot.take_outcome().filter(|shot| shot.id == *id)?;
                match &shot.png {
                    Ok(_) => {
                        let store = series.storing();
                        series.stage = PictureStage::Writing(Background::run(&waker_of(ctx), move || {
                            store(shot.png.as_deref().unwrap_or_default())
                        }));
                        None
                    }
                    Err(why) => {
                        let why = format!("No picture: {why}");
                        self.series = None;
                        Some(why)
                    }
                }
            }
            PictureStage::Writing(writing) => match writing.take()? {
                Ok(stored) => {
                    let file = match stored {
                        Stored::File(file) => file,
                        Stored::InMovie(movie, file) => {
                            series.writer = Some(movie);
                            series.path.clone_from(&file);
                            file
                        }
                    };
                    series.done += 1;
                    series.stage = PictureStage::Due;
                    ctx.request_repaint();
                    let is_all = series.done == series.total;
                    let told = match series.total {
                        _ if series.movie.is_some() => format!("Saved {}", file.display()),
                        1 => format!("Saved {}", file.display()),
                        total => format!("Saved {total} pictures in {}", series.path.display()),
                    };
                    if is_all {
                        self.series = None;
                    }
                    is_all.then_some(told)
                }
                Err(why) => {
                    self.series = None;
                    Some(format!("No picture: {why}"))
                }
            },
        }
    }

    /// Whether pictures are in progress.
    pub(crate) fn is_busy(&self) -> bool {
        self.series.is_some()
    }

    /// The source has changed: requested pictures will not come. Returns news for the person.
    pub(crate) fn forget(&mut self) -> Option<String> {
        (self.path, self.takes_path) = (None, false);
        Some(self.series.take()?.stopped())
    }

    /// The server answers no more. A picture that has arrived is still written. Returns news for the person.
    pub(crate) fn end(&mut self, source: &mut impl FrameSource, ctx: &Context) -> Option<String> {
        let is_due = matches!(self.series.as_ref().map(|series| &series.stage), Some(PictureStage::Due));
        let told = if is_due { None } else { self.poll(source, ctx) };
        match self.series.as_ref().map(|series| &series.stage) {
            Some(PictureStage::Due | PictureStage::Requested(_)) => self.cancel(source),
            Some(PictureStage::Writing(_)) | None => told,
        }
    }

    /// Stops what is in progress. Returns news for the person.
    fn cancel(&mut self, source: &mut impl FrameSource) -> Option<String> {
        let series = self.series.take()?;
        source.talk().screenshot.cancel();
        Some(series.stopped())
    }

    /// Shows the dialog if it is open, and the progress if there is any. `room` is the room for panes at the top.
    /// Returns news for the person.
    pub(crate) fn show(
        &mut self,
        ctx: &Context,
        subject: Option<Subject>,
        source: &mut impl FrameSource,
        room: egui::Rect,
    ) -> Option<String> {
        let mut is_cancelled = false;
        let is_connected = source.state() == State::Connected;
        if let Some(series) = &self.series {
            is_cancelled = show_progress(ctx, series, is_connected, room);
        }
        if self.is_dialog_open {
            self.show_dialog(ctx, subject, is_connected);
        }
        if is_cancelled { self.cancel(source) } else { None }
    }

    fn show_dialog(&mut self, ctx: &Context, subject: Option<Subject>, is_connected: bool) {
        let mut is_open = true;
        let (mut starts, mut saves_path) = (false, false);
        let total = self.total();
        let window = egui::Window::new(RichText::new("Picture of the view"));
        let window = window.open(&mut is_open).anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0));
        window.resizable(false).collapsible(false).show(ctx, |ui| {
            let of_window = subject.as_ref().map_or([0; 2], |s| [s.intrinsics.width, s.intrinsics.height]);
            let mut size = self.size.unwrap_or(of_window);
            egui::Grid::new("picture").num_columns(2).spacing([14.0, 6.0]).show(ui, |ui| {
                let label = ui.label("size");
                ui.horizontal(|ui| {
                    for (side, name) in size.iter_mut().zip(["width", "height"]) {
                        let value = whole(ui, side, 1..=MAX_SIDE).suffix(" px");
                        ui.add(value).labelled_by(label.id).on_hover_text(name);
                    }
                    if ui.button("Match window").clicked() {
                        size = of_window;
                    }
                });
                ui.end_row();
                if let Some(path) = &self.path {
                    ui.label("camera");
                    let seconds = path.duration().as_secs_f32();
                    ui.horizontal(|ui| {
                        ui.selectable_value(&mut self.takes_path, false, "as now");
                        let along = format!("along the path, {seconds:.1} s");
                        ui.selectable_value(&mut self.takes_path, true, along);
                        let save = ui.button("Save the path");
                        saves_path = save.on_hover_text("a text file for `isinglass render --path`").clicked();
                    });
                    ui.end_row();
                }
                let label = ui.label("pictures");
                match self.way() {
                    Some(_) => drop(ui.label(total.to_string())),
                    None => {
                        let number = whole(ui, &mut self.num_pictures, 1..=MAX_PICTURES);
                        let hint = "more than one: a turntable, once around the vertical through the centre of rotation";
                        ui.add(number).labelled_by(label.id).on_hover_text(hint);
                    }
                }
                ui.end_row();
                if total > 1 {
                    ui.label("format");
                    ui.horizontal(|ui| {
                        for (form, name, hint) in FORMS {
                            let choice = ui.selectable_label(self.movie == form, name);
                            if choice.on_hover_text(hint).clicked() {
                                self.movie = form;
                            }
                        }
                    });
                    ui.end_row();
                    ui.label("");
                    let seconds = total as f32 / PICTURES_PER_SECOND as f32;
                    ui.label(format!("{seconds:.1} s at {PICTURES_PER_SECOND} pictures a second"));
                    ui.end_row();
                }
                ui.label("overlays");
                ui.horizontal(|ui| {
                    controls::checkbox(ui, &mut self.has_scale, "scale bar");
                    controls::checkbox(ui, &mut self.has_legend, "colour legend");
                });
                ui.end_row();
                let is_movie = total > 1 && self.movie.is_some();
                ui.label("background");
                let transparent = ui.add_enabled_ui(!is_movie, |ui| {
                    controls::checkbox(ui, &mut self.is_transparent, "transparent")
                });
                transparent.inner.on_disabled_hover_text("a movie has a background");
                ui.end_row();
                let label = ui.label("folder");
                ui.add(egui::TextEdit::singleline(&mut self.folder).desired_width(260.0))
                    .labelled_by(label.id);
                ui.end_row();
            });
            self.size = (size != of_window).then_some(size);
            let is_fitting = size[0] as usize * size[1] as usize <= MAX_SCREENSHOT_PIXELS && size[0] > 0;
            if !is_fitting {
                ui.label(format!("at most {} million pixels", MAX_SCREENSHOT_PIXELS >> 20));
            }
            if !is_connected {
                ui.label("the server renders them, and there is no connection to it");
            }
            let is_possible = is_fitting && is_connected && subject.is_some() && self.series.is_none();
            let name = match (self.way(), total) {
                (Some(_), _) if self.movie.is_some() => "Make the movie",
                (Some(_), _) => "Take the pictures",
                (None, 1) => "Take the picture",
                (None, _) => "Make the turntable",
            };
            starts = ui.add_enabled(is_possible, egui::Button::new(name)).clicked();
        });
        if let (true, Some(subject)) = (saves_path, &subject) {
            self.save_path(ctx, &subject.name);
        }
        self.is_dialog_open = is_open && !starts;
        if let (true, Some(mut subject)) = (starts, subject) {
            if let Some([width, height]) = self.size {
                (subject.intrinsics.width, subject.intrinsics.height) = (width, height);
            }
            self.begin(ctx, subject, total, self.way().cloned());
        }
    }

    /// Number of pictures to make.
    fn total(&self) -> u32 {
        let along = |path: &Arc<CameraPath>| {
            // The last one is at the end.
            let num = (path.duration().as_secs_f32() * PICTURES_PER_SECOND as f32).ceil() as u32 + 1;
            num.min(MAX_PICTURES)
        };
        self.way().map_or(self.num_pictures, along)
    }

    /// Writes the recorded path as a text, for the volume `name`.
    fn save_path(&mut self, ctx: &Context, name: &str) {
        let Some(path) = self.path.clone().filter(|_| !self.saving_path.is_busy()) else { return };
        let name = files::file_name(name, OffsetDateTime::now_utc(), "-path.txt");
        let file = files::folder_from_text(&self.folder).join(name);
        self.saving_path = Background::run(&waker_of(ctx), move || {
            let text = path.to_string();
            files::write(&file, text.as_bytes()).map_err(|e| format!("{}: {e}", file.display()))
        });
    }
}

impl Series {
    fn stopped(&self) -> String {
        // A picture that is being written will be there.
        let done = self.done + u32::from(matches!(self.stage, PictureStage::Writing(_)));
        match (done, self.total) {
            // The last picture completes a movie.
            _ if self.movie.is_some() && done < self.total => "No movie was made".to_owned(),
            _ if self.movie.is_some() => format!("Saved {}", self.path.display()),
            (0, _) => "No picture was made".to_owned(),
            (_, 1) => format!("Saved {}", self.path.display()),
            (_, total) => format!("Stopped after {done} of {total} pictures, in {}", self.path.display()),
        }
    }

    /// The camera of the next picture. The first of a turntable is the window's own.
    fn pose(&self) -> Pose {
        let Subject { pose, intrinsics, bounds, center, up, .. } = self.subject;
        // Parallel rays begin at the eye, so the whole volume must be in front of it.
        let placed = |pose: Pose| match intrinsics.projection.is_orthographic() {
            true => pose.before(&bounds),
            false => pose,
        };
        if let Some(way) = &self.way {
            let at = Duration::from_secs_f32(self.done as f32 / PICTURES_PER_SECOND as f32);
            return way.pose_at(at, &intrinsics, &bounds).map_or(pose, placed);
        }
        if self.done == 0 {
            return pose;
        }
        let turn = std::f32::consts::TAU * self.done as f32 / self.total as f32;
        let turn = Quat::from_axis_angle(up, turn);
        let turned = Pose {
            eye: center + turn * (pose.eye - center),
            world_from_view: (turn * pose.world_from_view).normalize(),
        };
        placed(turned)
    }

    /// What stores the next picture, with its marks, in a file or in the movie.
    fn storing(&mut self) -> impl FnOnce(&[u8]) -> Result<Stored, String> + Send + 'static {
        let (mut path, marks, movie) = (self.file(), self.marks.clone(), self.movie);
        let (writer, total, is_last) = (self.writer.take(), self.total, self.done + 1 == self.total);
        move |png: &[u8]| {
            let drawn = marks.map(|marks| marks.draw(png, MAX_SCREENSHOT_PIXELS as u64)).transpose()?;
            let png = drawn.as_deref().unwrap_or(png);
            let Some(form) = movie else {
                let written = files::write(&path, png).map_err(|e| format!("{}: {e}", path.display()));
                return written.map(Stored::File);
            };
            let picture = png::decode(png, MAX_SCREENSHOT_PIXELS as u64).map_err(|e| e.to_string())?;
            let mut writer = match writer {
                Some(writer) => writer,
                None => {
                    if let Some(folder) = path.parent() {
                        let made = std::fs::create_dir_all(folder);
                        made.map_err(|e| format!("{}: {e}", folder.display()))?;
                    }
                    path = files::free(path);
                    let size = [picture.width, picture.height];
                    MovieWriter::create(&path, form, size, total, INTERVAL).map_err(|e| e.to_string())?
                }
            };
            writer.add(&picture).map_err(|e| e.to_string())?;
            if is_last {
                writer.finish(false).map_err(|e| e.to_string())?;
                return Ok(Stored::File(path));
            }
            Ok(Stored::InMovie(writer, path))
        }
    }

    fn file(&self) -> PathBuf {
        match self.total {
            _ if self.movie.is_some() => self.path.clone(),
            1 => self.path.clone(),
            _ => self.path.join(format!("{:04}.png", self.done)),
        }
    }
}

/// Shows the progress of a series; returns whether to cancel it.
fn show_progress(ctx: &Context, series: &Series, is_connected: bool, room: egui::Rect) -> bool {
    let place = (Align2::CENTER_TOP, [0.0, 46.0]);
    let row = |ui: &mut egui::Ui| {
        let text = match series.total {
            1 if is_connected => "the server renders the picture".to_owned(),
            1 => "the picture".to_owned(),
            total => format!("picture {} of {total}", series.done + 1),
        };
        if is_connected {
            ui.spinner();
            ui.label(text);
        } else {
            ui.label(format!("{text} waits until connected again"));
        }
        if series.total > 1 {
            let share = series.done as f32 / series.total as f32;
            ui.add(egui::ProgressBar::new(share).desired_width(120.0));
        }
        ui.button("Cancel").clicked()
    };
    pane_at(ctx, "pictures", room, place, |ui| ui.horizontal(row).inner).inner
}

const FORMS: [(Option<MovieForm>, &str, &str); 3] = [
    (None, "files", "numbered PNG files in a folder"),
    (Some(MovieForm::Gif), "GIF", "a movie that plays everywhere, with 256 colours a picture"),
    (Some(MovieForm::Apng), "APNG", "a movie with all colours, for browsers"),
];
/// A minute at 60 pictures a second.
const MAX_PICTURES: u32 = 3600;
/// The longest path that a movie shows whole.
pub(crate) const LONGEST_PATH: Duration =
    Duration::from_secs((MAX_PICTURES / PICTURES_PER_SECOND - 1) as u64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_movie_that_gets_its_last_picture_is_saved() {
        let series = |done, stage| Series {
            subject: marks::tests::subject(8, 8),
            way: None,
            total: 4,
            done,
            path: "a.gif".into(),
            is_transparent: false,
            marks: None,
            movie: Some(MovieForm::Gif),
            writer: None,
            stage,
        };
        let writing = || PictureStage::Writing(Background::default());
        assert_eq!(series(3, writing()).stopped(), "Saved a.gif");
        assert_eq!(series(3, PictureStage::Due).stopped(), "No movie was made");
        assert_eq!(series(2, writing()).stopped(), "No movie was made");
    }
}
