//! What all drawings share: theme, colours, numbers, axes, legends.

/// Colours of drawings in both schemes. It is part of every drawing, so that one saved by itself looks the same.
pub(crate) const THEME: &str = "<style>\
.fig{--ink:#1d2733;--soft:#5b6876;--grid:#dfe4ea;--paper:#fff;display:block;width:100%;height:auto;\
font:13px system-ui,-apple-system,'Segoe UI',Roboto,sans-serif;font-variant-numeric:tabular-nums}\
@media(prefers-color-scheme:dark){.fig{--ink:#e4e9ef;--soft:#9aa7b5;--grid:#333d48;--paper:#161b22}}\
.fig text{fill:var(--ink)}.fig .soft{fill:var(--soft)}.fig .grid{stroke:var(--grid)}\
.fig .axis{stroke:var(--soft)}.fig .halo{paint-order:stroke;stroke:var(--paper);stroke-width:3px;stroke-linejoin:round}\
.fig .end{text-anchor:end}.fig .mid{text-anchor:middle}.fig .b{font-weight:600}</style>";

/// Colour of series `i`; readable on white and on black.
pub(crate) fn colour(i: usize) -> &'static str {
    const COLOURS: [&str; 8] =
        ["#2f7ed8", "#e07b1a", "#2a9d6f", "#c2458f", "#8a63d2", "#b08a12", "#12a0b0", "#d1495b"];
    COLOURS[i % COLOURS.len()]
}

/// Text that may stand in HTML or SVG, also inside an attribute.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            _ => out.push(c),
        }
    }
    out
}

/// A coordinate with one decimal; what is not finite is drawn at 0.
pub(crate) fn px(v: f64) -> String {
    // Adding zero turns a negative zero into a plain one.
    format!("{:.1}", if v.is_finite() { (v * 10.0).round() / 10.0 + 0.0 } else { 0.0 })
}

/// Three significant digits, without trailing zeros; `–` for what is not finite.
pub(crate) fn number(v: f64) -> String {
    if !v.is_finite() {
        return "–".to_owned();
    }
    if v == 0.0 {
        return "0".to_owned();
    }
    let magnitude = v.abs().log10().floor();
    if !(-4.0..6.0).contains(&magnitude) {
        return format!("{v:.2e}");
    }
    // Between 0 and 6.
    let decimals = (2.0 - magnitude).max(0.0) as usize;
    let text = format!("{v:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A share in [0, 1] as a percentage.
pub(crate) fn percent(share: f64) -> String {
    if share.is_finite() { format!("{:.0}%", share * 100.0) } else { "–".to_owned() }
}

/// Round tick positions, about `count` of them, inside [lo, hi].
pub(crate) fn ticks(lo: f64, hi: f64, count: f64) -> Vec<f64> {
    let raw = (hi - lo) / count;
    if !(raw.is_finite() && raw > 0.0) {
        return vec![];
    }
    let power = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 2.5, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= raw).unwrap_or(raw);
    let first = (lo / step - 1e-9).ceil();
    (0..20).map(|i| (first + f64::from(i)) * step).take_while(|t| *t <= hi + step * 1e-9).collect()
}

/// One plotting rectangle and what its sides stand for.
pub(crate) struct Axes {
    pub(crate) left: f64,
    pub(crate) top: f64,
    pub(crate) width: f64,
    pub(crate) height: f64,
    /// Values at the left and right side.
    pub(crate) x: (f64, f64),
    /// Values at the bottom and the top.
    pub(crate) y: (f64, f64),
}

impl Axes {
    pub(crate) fn px(&self, x: f64) -> f64 {
        self.left + (x - self.x.0) / nonzero(self.x.1 - self.x.0) * self.width
    }

    pub(crate) fn py(&self, y: f64) -> f64 {
        self.top + self.height - (y - self.y.0) / nonzero(self.y.1 - self.y.0) * self.height
    }

    pub(crate) fn bottom(&self) -> f64 {
        self.top + self.height
    }

    pub(crate) fn right(&self) -> f64 {
        self.left + self.width
    }

    /// Horizontal grid lines with their numbers.
    pub(crate) fn grid(&self, ticks: &[f64], label: impl Fn(f64) -> String) -> String {
        let lines = ticks.iter().map(|&t| {
            let y = self.py(t);
            format!(
                "<path class=\"grid\" d=\"M{} {y:.1}H{}\"/><text class=\"soft end\" x=\"{}\" y=\"{}\">{}</text>",
                px(self.left),
                px(self.right()),
                px(self.left - 8.0),
                px(y + 4.5),
                label(t)
            )
        });
        lines.collect()
    }

    /// The line under the plot, numbers below it and the name of the axis below those.
    pub(crate) fn bottom_axis(&self, ticks: &[f64], label: impl Fn(f64) -> String, name: &str) -> String {
        let mut s = format!(
            "<path class=\"axis\" d=\"M{} {}H{}\"/>",
            px(self.left),
            px(self.bottom()),
            px(self.right())
        );
        for &t in ticks {
            let (x, y) = (px(self.px(t)), px(self.bottom() + 17.0));
            s += &format!("<text class=\"soft mid\" x=\"{x}\" y=\"{y}\">{}</text>", label(t));
        }
        let (x, y) = (px(self.left + self.width / 2.0), px(self.bottom() + 36.0));
        s + &format!("<text class=\"mid\" x=\"{x}\" y=\"{y}\">{}</text>", escape(name))
    }

    /// Name of the vertical axis, written upwards at `x`.
    pub(crate) fn side_name(&self, x: f64, name: &str) -> String {
        let y = px(self.top + self.height / 2.0);
        let x = px(x);
        format!(
            "<text class=\"mid\" x=\"{x}\" y=\"{y}\" transform=\"rotate(-90 {x} {y})\">{}</text>",
            escape(name)
        )
    }

    /// A point with its interval [`lo`, `hi`] and a title that shows where a pointer rests.
    pub(crate) fn bar(&self, x: f64, y: f64, [lo, hi]: [f64; 2], colour: &str, title: &str) -> String {
        let (x, y) = (self.px(x), self.py(y));
        format!(
            "<g stroke=\"{colour}\" fill=\"{colour}\"><title>{}, 95% {} to {}</title>\
             <path class=\"bar\" stroke-width=\"1.6\" d=\"M{x0} {hi_y}H{x1}M{x} {hi_y}V{lo_y}M{x0} {lo_y}H{x1}\"/>\
             <circle cx=\"{x}\" cy=\"{y}\" r=\"4\"/></g>",
            escape(title),
            percent(lo),
            percent(hi),
            x0 = px(x - 4.0),
            x1 = px(x + 4.0),
            x = px(x),
            y = px(y),
            hi_y = px(self.py(hi)),
            lo_y = px(self.py(lo)),
        )
    }

    /// A line through the points; a gap where one is not finite.
    pub(crate) fn line(&self, points: impl Iterator<Item = (f64, f64)>, style: &str) -> String {
        let (mut d, mut pen) = (String::new(), 'M');
        for (x, y) in points {
            if x.is_finite() && y.is_finite() {
                d += &format!("{pen}{} {}", px(self.px(x)), px(self.py(y)));
                pen = 'L';
            } else {
                pen = 'M';
            }
        }
        format!("<path d=\"{d}\" fill=\"none\" stroke-linejoin=\"round\" {style}/>")
    }
}

fn nonzero(v: f64) -> f64 {
    if v == 0.0 { 1.0 } else { v }
}

/// Rough width of a text in the drawings' font, in its units.
pub(crate) fn text_width(text: &str) -> f64 {
    text.chars().count() as f64 * 7.1
}

/// Entries (label, fill) in rows of at most `width`, the first row centred on `y`. Returns the height taken too.
pub(crate) fn legend(entries: &[(String, String)], left: f64, y: f64, width: f64) -> (String, f64) {
    let (mut s, mut x, mut row) = (String::new(), left, 0.0);
    for (label, fill) in entries {
        let step = 38.0 + text_width(label);
        if x > left && x + step > left + width {
            (x, row) = (left, row + 22.0);
        }
        s += &format!(
            "<rect x=\"{}\" y=\"{}\" width=\"18\" height=\"12\" rx=\"2\" fill=\"{fill}\"/><text x=\"{}\" y=\"{}\">{}</text>",
            px(x),
            px(y + row - 6.0),
            px(x + 24.0),
            px(y + row + 4.5),
            escape(label)
        );
        x += step;
    }
    (s, if entries.is_empty() { 0.0 } else { row + 22.0 })
}

/// A whole drawing. `label` is what a screen reader says.
pub(crate) fn document(width: f64, height: f64, label: &str, body: &str) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"fig\" viewBox=\"0 0 {} {}\" role=\"img\" \
         aria-label=\"{}\">{THEME}{body}</svg>",
        px(width),
        px(height),
        escape(label)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (v, text) in [
            (0.0, "0"),
            (0.5, "0.5"),
            (0.04, "0.04"),
            (123.4, "123"),
            (1200.0, "1200"),
            (-0.01234, "-0.0123"),
            (1e-7, "1.00e-7"),
            (f64::NAN, "–"),
        ] {
            assert_eq!(number(v), text);
        }
        assert_eq!((px(-0.01), px(f64::NAN), px(2.25)), ("0.0".into(), "0.0".into(), "2.3".into()));
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 1.0, 5.0).len(), 6);
        assert_eq!(ticks(-0.5, 1.2, 4.0), [-0.5, 0.0, 0.5, 1.0]);
        assert!(ticks(1.0, 1.0, 4.0).is_empty() && ticks(0.0, f64::NAN, 4.0).is_empty());
    }

    #[test]
    fn a_line_breaks_at_what_is_not_finite() {
        let axes = Axes { left: 0.0, top: 0.0, width: 10.0, height: 10.0, x: (0.0, 3.0), y: (0.0, 1.0) };
        let ys = [0.0, f64::NAN, 1.0, 0.0];
        let line = axes.line(ys.iter().enumerate().map(|(i, y)| (i as f64, *y)), "");
        assert_eq!(line.matches('M').count(), 2);
        assert_eq!(line.matches('L').count(), 1);
    }
}
