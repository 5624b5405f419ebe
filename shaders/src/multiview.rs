//! Modules for passes that draw both eyes at once: the text of [`Module`], with the view looked up by
//! `@builtin(view_index)`.
//!
//! WGSL has no conditions for what a module may declare, and a device without multiview takes no module that mentions it; so one text is
//! written, for one view, and the other is made of it.

use crate::source::{ImportError, Module};

/// Views that one pass draws.
pub const VIEWS: u32 = 2;
/// Bytes from one view's uniform to the next: WebGPU's alignment of dynamic offsets, so that any view can be the first.
pub const VIEW_STRIDE: u32 = 256;

/// What stands for one view in the text for one, and what for both.
const ONE: [&str; 2] = ["@group(0) @binding(0) var<uniform> view: View;\n", "const view_at: u32 = 0u;\n"];

impl Module {
    /// As [`Module::source`], for a pass of both eyes: the device needs multiview.
    ///
    /// # Errors
    /// As [`Module::source`].
    pub fn multiview_source(self) -> Result<String, ImportError> {
        Ok(of_both(&self.source()?))
    }
}

fn of_both(text: &str) -> String {
    let slots = format!(
        "struct ViewSlot {{ @size({VIEW_STRIDE}) own: View }}\n@group(0) @binding(0) var<uniform> views: array<ViewSlot, {VIEWS}>;\n"
    );
    let [uniform, at] = ONE;
    let text = text.replace(uniform, &slots).replace(at, "var<private> view_at: u32;\n");
    told_view(&look_up(&text))
}

/// The text with `view.` looked up among the views.
fn look_up(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("view.") {
        let (before, after) = rest.split_at(at);
        out.push_str(before);
        let within = before.chars().next_back().is_some_and(|c| c.is_alphanumeric() || c == '_' || c == '.');
        out.push_str(if within { "view." } else { "views[view_at].own." });
        rest = &after["view.".len()..];
    }
    out + rest
}

/// The text in which every entry point is told its view.
fn told_view(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut awaited = false;
    let mut opened = false;
    for line in text.lines() {
        awaited |= line.starts_with("@vertex") || line.starts_with("@fragment");
        let mut line = line.to_owned();
        if awaited && line.starts_with("fn ") {
            line = line.replacen('(', "(@builtin(view_index) view_index: u32, ", 1);
            (awaited, opened) = (false, true);
        }
        let body = opened && line.ends_with('{');
        out.push_str(&line);
        out.push('\n');
        if body {
            out.push_str("    view_at = view_index;\n");
            opened = false;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    use super::*;

    /// Those that draw views.
    const DRAWN: [Module; 6] = [Module::Object, Module::Glass, Module::Ground, Module::MirrorMip, Module::Composite, Module::EyeProbe];

    #[test]
    fn every_module_of_the_views_has_a_valid_text_for_both_eyes() {
        for module in DRAWN {
            let source = module.multiview_source().unwrap();
            let parsed = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{}: {}", module.file(), error.emit_to_string_with_path(&source, module.file())));
            Validator::new(ValidationFlags::all(), Capabilities::MULTIVIEW)
                .validate(&parsed)
                .unwrap_or_else(|error| panic!("{}: {}", module.file(), error.emit_to_string(&source)));
            // Each is told its view first of all.
            let entries = source.matches("@vertex").count() + source.matches("@fragment").count();
            assert_eq!(source.matches("    view_at = view_index;\n").count(), entries, "{}", module.file());
            assert_eq!(parsed.entry_points.len(), entries, "{}", module.file());
        }
    }

    #[test]
    fn views_lie_a_stride_apart() {
        let source = Module::Composite.multiview_source().unwrap();
        let parsed = naga::front::wgsl::parse_str(&source).unwrap();
        let stride = parsed.types.iter().find_map(|(_, ty)| match &ty.inner {
            naga::TypeInner::Array { base, stride, .. } => (parsed.types[*base].name.as_deref() == Some("ViewSlot")).then_some(*stride),
            _ => None,
        });
        assert_eq!(stride, Some(VIEW_STRIDE));
        assert!(size_of::<crate::layout::View>() <= VIEW_STRIDE as usize);
    }

    #[test]
    fn only_the_view_itself_is_looked_up() {
        let text = "let a = view.x + probe.view.z + review.y - (view.w);";
        assert_eq!(look_up(text), "let a = views[view_at].own.x + probe.view.z + review.y - (views[view_at].own.w);");
        let entry = "@fragment\nfn fs(\n    in: A,\n) -> B {\n    return f();\n}\nfn f() -> B {\n}\n";
        let told = told_view(entry);
        assert!(
            told.starts_with("@fragment\nfn fs(@builtin(view_index) view_index: u32, \n    in: A,\n) -> B {\n    view_at = view_index;\n"),
            "{told}"
        );
        assert_eq!(told.matches("view_at").count(), 1);
    }
}
