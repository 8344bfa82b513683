//! The help: every key and mouse gesture and what it does, by task, with a field that finds some of them.

use egui::{Align2, Color32, RichText, Ui, vec2};

use super::style::{bright, named, quiet, title};
use crate::input::bindings::Bindings;

/// A title and its lines: keys and what they do.
type Task = (&'static str, Vec<(String, &'static str)>);

/// Shows the keys in the middle of the window, in as many columns as have room. A low window scrolls. `search` is the
/// text of the field.
pub(crate) fn show(ctx: &egui::Context, bindings: &Bindings, open: &mut bool, search: &mut String) {
    if !*open {
        search.clear();
    }
    egui::Window::new("Keys and mouse")
        .id(egui::Id::unique("help"))
        .open(open)
        .anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0))
        .auto_sized()
        .collapsible(false)
        .show(ctx, |ui| {
            let screen = ctx.content_rect().size();
            let height = (screen.y - 120.0).max(80.0);
            // The scroll bar has its own room.
            let bar = ui.spacing().scroll.allocated_width();
            let width = (screen.x - 64.0 - bar).clamp(120.0, MOST_WIDTH);
            let num_columns = ((width / LEAST_WIDTH_OF_COLUMN) as usize).clamp(1, MOST_COLUMNS);
            let field = egui::TextEdit::singleline(search).hint_text("find a key or a word");
            let field = ui.add(field.desired_width((width - 24.0).min(280.0)));
            named(&field, egui::Role::TextInput, "find in the help");
            ui.add_space(4.0);
            let tasks = matching(bindings.tasks(), search);
            if tasks.is_empty() {
                let text = format!("No match for \"{}\".", search.trim());
                ui.add(egui::Label::new(RichText::new(text).color(quiet(ctx))).wrap());
            }
            let column = width / num_columns as f32 - GAPS.x;
            let tasks: Vec<_> = tasks.iter().map(|task| TaskBlock::of(ui, task, column)).collect();
            let columns = in_columns(&tasks, num_columns);
            let room = height - field.rect.height() - 4.0;
            let size = vec2(width, columns.iter().map(|c| height_of(c)).fold(0.0, f32::max));
            let scroll = egui::ScrollArea::vertical().max_height(room).min_scrolled_height(room);
            scroll.show(ui, |ui| draw(ui, &columns, size, column));
        });
}

/// The lines that say what is searched for. A task without one is left out.
fn matching(tasks: Vec<Task>, search: &str) -> Vec<Task> {
    let search = search.trim().to_lowercase();
    let says = |text: &str| text.to_lowercase().contains(&search);
    let left = tasks.into_iter().map(|(task, lines)| match says(task) {
        true => (task, lines),
        false => (task, lines.into_iter().filter(|(keys, text)| says(keys) || says(text)).collect()),
    });
    left.filter(|(_, lines)| !lines.is_empty()).collect()
}

/// A task with its sizes, which are known before drawing: egui would cut off a table whose size it has to find.
struct TaskBlock<'a> {
    task: &'a Task,
    /// Width of the keys with the gap beside them, points.
    keys_width: f32,
    /// Height of each line with the gap below it, points.
    heights: Vec<f32>,
}

impl<'a> TaskBlock<'a> {
    /// In a column of `width` points. What needs more wraps.
    fn of(ui: &Ui, task: &'a Task, width: f32) -> Self {
        let font = egui::TextStyle::Body.resolve(ui.style());
        let size = |text: &str, width: f32| {
            ui.painter().layout(text.to_owned(), font.clone(), Color32::WHITE, width).size().ceil()
        };
        let lines = &task.1;
        let widest = lines.iter().map(|(keys, _)| size(keys, f32::INFINITY).x + 1.0).fold(0.0, f32::max);
        let keys_width = widest.min(0.4 * width) + KEY_GAP;
        let height = |(keys, text): &(String, &str)| {
            size(keys, keys_width - KEY_GAP).y.max(size(text, width - keys_width).y) + GAPS.y
        };
        Self { task, keys_width, heights: lines.iter().map(height).collect() }
    }

    fn height(&self) -> f32 {
        TITLE_HEIGHT + self.heights.iter().sum::<f32>()
    }
}

fn height_of(column: &[&TaskBlock<'_>]) -> f32 {
    column.iter().map(|block| block.height()).sum()
}

/// Puts the tasks into columns of about one height. Each task goes to the column that is lowest so far.
fn in_columns<'a, 'b>(tasks: &'b [TaskBlock<'a>], num_columns: usize) -> Vec<Vec<&'b TaskBlock<'a>>> {
    let mut columns: Vec<Vec<&TaskBlock<'_>>> = vec![Vec::new(); num_columns];
    for task in tasks {
        let lowest = columns.iter_mut().min_by(|a, b| height_of(a).total_cmp(&height_of(b)));
        lowest.expect("there is a column").push(task);
    }
    columns
}

/// Draws columns of `column` points side by side, which take `size` in all.
fn draw(ui: &mut Ui, columns: &[Vec<&TaskBlock<'_>>], size: egui::Vec2, column: f32) {
    let (rect, _) = ui.allocate_exact_size(size, egui::Sense::hover());
    let (bright, quiet) = (bright(ui.ctx()), quiet(ui.ctx()));
    let mut cell = |at: egui::Pos2, size: egui::Vec2, text: RichText| {
        let cell = egui::UiBuilder::new().max_rect(egui::Rect::from_min_size(at, size));
        ui.scope_builder(cell, |ui| ui.add(egui::Label::new(text).wrap()));
    };
    for (number, blocks) in columns.iter().enumerate() {
        let mut at = rect.min + vec2(number as f32 * (column + GAPS.x), 0.0);
        for TaskBlock { task: (name, lines), keys_width, heights } in blocks {
            cell(at, vec2(column, TITLE_HEIGHT), title(name).color(bright));
            at.y += TITLE_HEIGHT - GAPS.y;
            for ((keys, text), height) in lines.iter().zip(heights) {
                let keys = RichText::new(keys).color(bright).strong();
                cell(at, vec2(keys_width - KEY_GAP, *height), keys);
                let text_width = column - keys_width;
                cell(
                    at + vec2(*keys_width, 0.0),
                    vec2(text_width, *height),
                    RichText::new(*text).color(quiet),
                );
                at.y += height;
            }
            at.y += GAPS.y;
        }
    }
}

/// Between columns and between lines, points.
const GAPS: egui::Vec2 = vec2(24.0, 4.0);
/// Between keys and what they do, points.
const KEY_GAP: f32 = 8.0;
/// Height of a title with the gaps around it, points.
const TITLE_HEIGHT: f32 = 32.0;
const MOST_COLUMNS: usize = 4;
/// Points.
const LEAST_WIDTH_OF_COLUMN: f32 = 250.0;
/// More room makes lines hard to follow, points.
const MOST_WIDTH: f32 = 1360.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_search_leaves_the_lines_that_say_it() {
        let bindings = Bindings::default();
        let all = bindings.tasks();
        let num = |tasks: &[Task]| tasks.iter().map(|(_, lines)| lines.len()).sum::<usize>();
        assert!(all.len() == 4 && num(&all) == bindings.lines().len(), "every line is in a task");
        assert_eq!(matching(all.clone(), "  "), all);
        let found = matching(all.clone(), "CLIP");
        assert!(num(&found) >= 1 && num(&found) < 4, "{found:?}");
        assert!(found[0].1.iter().all(|(_, text)| text.to_lowercase().contains("clip")));
        // By a key, and by a task.
        assert!(matching(all.clone(), "f12").iter().any(|(_, lines)| lines[0].1.contains("picture")));
        assert_eq!(matching(all.clone(), "colours and light"), [all[1].clone()]);
        assert_eq!(matching(all, "no such thing"), []);
    }
}
