//! The look of all controls, dark and light. There is one accent colour; amber and red mean trouble. Text has one size,
//! titles another, and distances follow an 8-point grid.

use egui::style::{ScrollStyle, WidgetVisuals};
use egui::{
    Color32, CornerRadius, FontFamily, FontId, Margin, Shadow, Stroke, Style, TextStyle, Theme, vec2,
};

/// The colours of a theme. A test holds their contrast on every background.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Palette {
    /// Bars, docked panels and pages.
    pub(crate) surface: Color32,
    /// Panes over the picture; nearly opaque, as the picture has any colour.
    pub(crate) pane: Color32,
    /// Cards on a page.
    pub(crate) card: Color32,
    /// Fields for text, and lists.
    pub(crate) field: Color32,
    /// Buttons: at rest, under the pointer, pressed.
    pub(crate) buttons: [Color32; 3],
    /// Outlines of buttons and fields, and the rails of sliders.
    pub(crate) outline: Color32,
    /// Outlines of what is under the pointer or has the keyboard.
    pub(crate) strong: Color32,
    /// Lines between parts of a panel, which nobody has to see to work with it.
    pub(crate) line: Color32,
    /// Text and titles.
    pub(crate) bright: Color32,
    /// Text beside other text.
    pub(crate) quiet: Color32,
    /// What is chosen, has the keyboard, or goes on.
    pub(crate) accent: Color32,
    /// Behind what is chosen, and the text on it.
    pub(crate) chosen: [Color32; 2],
    /// What is done and good.
    pub(crate) done: Color32,
    /// Trouble.
    pub(crate) amber: Color32,
    /// Trouble that ends something.
    pub(crate) red: Color32,
}

const DARK: Palette = Palette {
    surface: Color32::from_rgb(24, 26, 31),
    pane: Color32::from_rgba_premultiplied(13, 15, 19, 242),
    card: Color32::from_rgb(33, 36, 42),
    field: Color32::from_rgb(13, 14, 17),
    buttons: [Color32::from_rgb(46, 49, 57), Color32::from_rgb(60, 64, 74), Color32::from_rgb(36, 39, 46)],
    outline: Color32::from_gray(116),
    strong: Color32::from_rgb(74, 128, 190),
    line: Color32::from_rgb(58, 62, 70),
    bright: Color32::from_gray(232),
    quiet: Color32::from_gray(178),
    accent: Color32::from_rgb(110, 175, 245),
    chosen: [Color32::from_rgb(30, 78, 132), Color32::from_rgb(232, 242, 255)],
    done: Color32::from_rgb(110, 205, 130),
    amber: Color32::from_rgb(245, 200, 115),
    red: Color32::from_rgb(255, 140, 130),
};

const LIGHT: Palette = Palette {
    surface: Color32::from_rgb(243, 244, 246),
    pane: Color32::from_rgba_premultiplied(234, 235, 237, 242),
    card: Color32::WHITE,
    field: Color32::WHITE,
    buttons: [
        Color32::from_rgb(226, 229, 233),
        Color32::from_rgb(212, 217, 224),
        Color32::from_rgb(198, 204, 212),
    ],
    outline: Color32::from_gray(126),
    strong: Color32::from_rgb(66, 128, 200),
    line: Color32::from_rgb(202, 206, 212),
    bright: Color32::from_gray(20),
    quiet: Color32::from_gray(70),
    accent: Color32::from_rgb(18, 88, 176),
    chosen: [Color32::from_rgb(184, 211, 245), Color32::from_rgb(10, 42, 90)],
    done: Color32::from_rgb(16, 105, 40),
    amber: Color32::from_rgb(132, 66, 0),
    red: Color32::from_rgb(172, 22, 22),
};

impl Palette {
    pub(crate) fn of(theme: Theme) -> Self {
        match theme {
            Theme::Dark => DARK,
            Theme::Light => LIGHT,
        }
    }
}

/// Gives both themes of a window their look.
pub(super) fn install(ctx: &egui::Context) {
    for theme in [Theme::Dark, Theme::Light] {
        ctx.style_mut_of(theme, |style| set(style, &Palette::of(theme)));
    }
}

fn set(style: &mut Style, colors: &Palette) {
    let sizes = [
        (TextStyle::Small, 12.0),
        (TextStyle::Body, TEXT_SIZE),
        (TextStyle::Button, TEXT_SIZE),
        (TextStyle::Heading, TITLE_SIZE),
    ];
    for (text, size) in sizes {
        style.text_styles.insert(text, FontId::new(size, FontFamily::Proportional));
    }
    style.text_styles.insert(TextStyle::Monospace, FontId::new(12.0, FontFamily::Monospace));
    let spacing = &mut style.spacing;
    (spacing.item_spacing, spacing.button_padding) = (vec2(8.0, 4.0), vec2(8.0, 2.0));
    (spacing.interact_size, spacing.indent) = (vec2(40.0, 20.0), 16.0);
    (spacing.window_margin, spacing.menu_margin) = (Margin::same(8), Margin::same(8));
    (spacing.slider_rail_height, spacing.tooltip_width) = (4.0, 320.0);
    // A bar of its own width: never over the controls.
    spacing.scroll = ScrollStyle {
        bar_width: 8.0,
        dormant_background_opacity: 0.0,
        dormant_handle_opacity: 0.8,
        active_handle_opacity: 0.9,
        ..ScrollStyle::solid()
    };
    let visuals = &mut style.visuals;
    (visuals.panel_fill, visuals.window_fill) = (colors.surface, colors.surface);
    visuals.window_stroke = Stroke::new(1.0, colors.line);
    let shadow = Shadow { offset: [0, 4], blur: 12, spread: 0, color: Color32::from_black_alpha(80) };
    (visuals.window_shadow, visuals.popup_shadow) = (shadow, shadow);
    (visuals.extreme_bg_color, visuals.faint_bg_color) = (colors.field, colors.buttons[2]);
    visuals.weak_text_color = Some(colors.quiet);
    (visuals.hyperlink_color, visuals.warn_fg_color, visuals.error_fg_color) =
        (colors.accent, colors.amber, colors.red);
    visuals.selection.bg_fill = colors.chosen[0];
    visuals.selection.stroke = Stroke::new(1.0, colors.chosen[1]);
    visuals.handle_shape = egui::style::HandleShape::Circle;
    let [rest, hovered, pressed] = colors.buttons;
    let widgets = &mut visuals.widgets;
    // Rails and handles of sliders, scroll bars and check boxes are as visible as outlines.
    let look = |fill: Color32, line: Color32, text: Color32| WidgetVisuals {
        bg_fill: line,
        weak_bg_fill: fill,
        bg_stroke: Stroke::new(1.0, line),
        fg_stroke: Stroke::new(1.0, text),
        corner_radius: CornerRadius::same(4),
        expansion: 0.0,
    };
    widgets.noninteractive = look(colors.surface, colors.line, colors.bright);
    widgets.inactive = look(rest, colors.outline, colors.bright);
    widgets.hovered = look(hovered, colors.strong, colors.bright);
    widgets.active = look(pressed, colors.strong, colors.bright);
    widgets.open = look(pressed, colors.outline, colors.bright);
}

/// Size of text, points.
pub(crate) const TEXT_SIZE: f32 = 13.0;
/// Size of titles, points.
pub(crate) const TITLE_SIZE: f32 = 15.0;

/// WCAG's contrast of two opaque colours, from 1 to 21.
#[cfg(test)]
pub(crate) fn contrast(a: Color32, b: Color32) -> f32 {
    let luminance = |color: Color32| {
        let [r, g, b, _] = egui::Rgba::from(color).to_array();
        0.2126 * r + 0.7152 * g + 0.0722 * b
    };
    let (a, b) = (luminance(a), luminance(b));
    (a.max(b) + 0.05) / (a.min(b) + 0.05)
}

#[cfg(test)]
mod tests {
    use egui::Visuals;

    use super::*;

    fn over(top: Color32, below: Color32) -> Color32 {
        below.blend(top)
    }

    /// What cannot be seen well enough: in a theme, with these visuals, over a background of the picture.
    fn faults(visuals: &Visuals, colors: &Palette) -> Vec<String> {
        let mut found = Vec::new();
        let mut need = |what: String, a: Color32, b: Color32, least: f32| {
            let contrast = contrast(a, b);
            if contrast < least {
                found.push(format!("{what}: {contrast:.2}, at least {least}"));
            }
        };
        let places =
            super::super::BACKGROUNDS.map(|(_, [r, g, b])| over(colors.pane, Color32::from_rgb(r, g, b)));
        let places = places.into_iter().chain([visuals.panel_fill, visuals.window_fill, colors.card]);
        let widgets = &visuals.widgets;
        for place in places {
            for (name, text) in [
                ("text", visuals.text_color()),
                ("weak text", visuals.weak_text_color()),
                ("quiet text", colors.quiet),
                ("what is chosen", colors.accent),
                ("what is done", colors.done),
                ("a strong text", visuals.strong_text_color()),
                ("a link", visuals.hyperlink_color),
                ("trouble", visuals.warn_fg_color),
                ("an error", visuals.error_fg_color),
            ] {
                need(format!("{name} on {place:?}"), text, place, 4.5);
            }
            for (name, line) in [
                ("the outline of a button", widgets.inactive.bg_stroke.color),
                ("the outline under the pointer", widgets.hovered.bg_stroke.color),
                ("the outline of what is pressed", widgets.active.bg_stroke.color),
                ("the handle of a slider", widgets.inactive.fg_stroke.color),
                ("the rail of a slider", widgets.inactive.bg_fill),
                ("the keyboard's place", colors.accent),
            ] {
                need(format!("{name} on {place:?}"), line, place, 3.0);
            }
        }
        for (name, look) in
            [("at rest", widgets.inactive), ("hovered", widgets.hovered), ("pressed", widgets.active)]
        {
            need(format!("text of a button {name}"), look.text_color(), look.weak_bg_fill, 4.5);
            need(format!("check mark {name}"), look.fg_stroke.color, look.bg_fill, 3.0);
        }
        need("chosen text".into(), visuals.selection.stroke.color, visuals.selection.bg_fill, 4.5);
        need("text in a field".into(), visuals.text_color(), visuals.text_edit_bg_color(), 4.5);
        need("a hint in a field".into(), visuals.weak_text_color(), visuals.text_edit_bg_color(), 4.5);
        need("an empty field".into(), widgets.inactive.bg_stroke.color, visuals.text_edit_bg_color(), 3.0);
        found
    }

    #[test]
    fn all_texts_and_controls_are_seen_in_both_themes_on_any_background() {
        let ctx = egui::Context::default();
        super::super::install(&ctx);
        for theme in [Theme::Dark, Theme::Light] {
            let colors = Palette::of(theme);
            let visuals = ctx.style_of(theme).visuals.clone();
            let found = faults(&visuals, &colors);
            assert_eq!(found, Vec::<String>::new(), "{theme:?}");
            assert!(!ctx.style_of(theme).spacing.scroll.floating, "a bar over buttons");
            // The controls: egui's own look, and a pane through which the picture is seen.
            let plain = theme.default_visuals();
            assert!(!faults(&plain, &colors).is_empty(), "{theme:?}");
            let thin = Palette { pane: colors.pane.gamma_multiply(0.5), ..colors };
            assert!(!faults(&visuals, &thin).is_empty(), "{theme:?}");
        }
        assert!((contrast(Color32::WHITE, Color32::BLACK) - 21.0).abs() < 0.01);
        assert!((contrast(Color32::from_gray(119), Color32::WHITE) - 4.48).abs() < 0.02);
    }

    #[test]
    fn digits_have_one_width_and_letters_do_not() {
        let ctx = egui::Context::default();
        super::super::install(&ctx);
        let mut widths = Vec::new();
        let mut output = ctx.run_ui(egui::RawInput::default(), |ui| {
            let font = TextStyle::Body.resolve(ui.style());
            let width = |c: char| ui.fonts_mut(|fonts| fonts.glyph_width(&font, c));
            widths = "0123456789iW".chars().map(width).collect();
        });
        output.textures_delta.clear();
        assert!(widths[..10].iter().all(|w| (w - widths[0]).abs() < 1e-3), "{widths:?}");
        assert!(widths[10] < widths[11], "{widths:?}");
    }
}
