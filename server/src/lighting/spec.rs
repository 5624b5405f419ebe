//! The light methods by name, with their parameter: what `--method` takes.

use std::fmt;
use std::str::FromStr;

use mr360_protocol::light::{MAX_LIGHTS, SH9, SH25};

use super::cuts::{LightCuts, Rule};
use super::kmeans::KMeans;
use super::sampling::Grid;
use super::spherical::{self, SphericalHarmonics};
use super::{Directional, Iorns, LightMethod, Mr360, directional, mr360};

/// One method's entry in [`METHODS`].
struct Entry {
    name: &'static str,
    parameter: Option<Parameter>,
    make: fn(usize) -> Box<dyn LightMethod>,
    resized: Option<Resized>,
    /// Made with lights from a share of the upper hemisphere's energy on.
    from: Option<fn(f64) -> Box<dyn LightMethod>>,
}

/// How a method is made with a working panorama of another size.
struct Resized {
    usual: Grid,
    make: fn(usize, Grid) -> Box<dyn LightMethod>,
}

/// The number after a method's name.
struct Parameter {
    meaning: &'static str,
    allowed: Allowed,
    default: usize,
}

enum Allowed {
    UpTo(usize),
    OneOf(&'static [usize]),
}

impl Allowed {
    fn contains(&self, value: usize) -> bool {
        match self {
            Self::UpTo(most) => (1..=*most).contains(&value),
            Self::OneOf(values) => values.contains(&value),
        }
    }
}

/// As it follows the colon: `1-64`, `9|25`.
impl fmt::Display for Allowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UpTo(most) => write!(f, "1-{most}"),
            Self::OneOf(values) => values.iter().enumerate().try_for_each(|(i, v)| write!(f, "{}{v}", if i > 0 { "|" } else { "" })),
        }
    }
}

/// Lights unless asked otherwise; within the 8 to 64 of Rohmer et al. 2015, Section 4.3.
const DEFAULT_LIGHTS: usize = 16;

const fn lights() -> Option<Parameter> {
    Some(Parameter { meaning: "number of lights", allowed: Allowed::UpTo(MAX_LIGHTS), default: DEFAULT_LIGHTS })
}

/// Every method. The first is the default.
static METHODS: [Entry; 7] = [
    Entry {
        name: "directional",
        parameter: None,
        make: |_| Box::new(Directional::default()),
        resized: Some(Resized { usual: directional::SIZE, make: |_, size| Box::new(Directional::with_size(size)) }),
        from: Some(|share| Box::new(Directional::with_least_share(share))),
    },
    Entry {
        name: "mr360",
        parameter: None,
        make: |_| Box::new(Mr360::default()),
        resized: Some(Resized { usual: mr360::SIZE, make: |_, size| Box::new(Mr360::with_size(size, true)) }),
        from: None,
    },
    Entry { name: "iorns", parameter: None, make: |_| Box::new(Iorns::default()), resized: None, from: None },
    Entry {
        name: "sh",
        parameter: Some(Parameter { meaning: "number of coefficients", allowed: Allowed::OneOf(&[SH9, SH25]), default: SH9 }),
        make: |coefficients| Box::new(SphericalHarmonics::new(coefficients)),
        resized: Some(Resized {
            usual: spherical::SIZE,
            make: |coefficients, size| Box::new(SphericalHarmonics::with_size(size, coefficients)),
        }),
        from: None,
    },
    Entry {
        name: "median-cut",
        parameter: lights(),
        make: |lights| Box::new(LightCuts::new(Rule::Median, lights)),
        resized: None,
        from: None,
    },
    Entry {
        name: "variance-cut",
        parameter: lights(),
        make: |lights| Box::new(LightCuts::new(Rule::Variance, lights)),
        resized: None,
        from: None,
    },
    Entry { name: "k-means", parameter: lights(), make: |lights| Box::new(KMeans::new(lights)), resized: None, from: None },
];

/// A light method and its parameter, as `--method` names them: `NAME` or `NAME:N`. What cannot be made cannot be parsed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Deserialize)]
#[serde(try_from = "String")]
pub struct MethodSpec {
    /// Place in [`METHODS`].
    method: usize,
    /// Zero for a method without one.
    parameter: usize,
}

impl MethodSpec {
    /// Every method with its default parameter, the default method first.
    pub fn all() -> impl Iterator<Item = Self> {
        METHODS.iter().enumerate().map(|(method, entry)| Self { method, parameter: entry.parameter.as_ref().map_or(0, |p| p.default) })
    }

    /// The method's name without its parameter.
    #[must_use]
    pub fn name(self) -> &'static str {
        METHODS[self.method].name
    }

    /// Makes the method. It knows nothing of any frame yet.
    #[must_use]
    pub fn make(self) -> Box<dyn LightMethod> {
        (METHODS[self.method].make)(self.parameter)
    }

    /// Makes the method with a working panorama of `width`×`width / 2` texels, to measure what its own size costs and brings. As many source
    /// blocks go into a texel as usual, or as few as keep the usual number along a row. `None` for a method that keeps its size, and for
    /// widths that are no power of two from 8 to 1024.
    #[must_use]
    pub fn make_at(self, width: u32) -> Option<Box<dyn LightMethod>> {
        let Resized { usual, make } = METHODS[self.method].resized.as_ref()?;
        let possible = width.is_power_of_two() && (8..=1024).contains(&width);
        let supersample = usual.supersample.min((usual.width * usual.supersample / width.max(1)).max(1));
        possible.then(|| make(self.parameter, Grid { width, height: width / 2, supersample }))
    }

    /// Makes the method with lights from `share` of the upper hemisphere's energy on, in (0, 1], kept down to half of that, to measure what lights cost and
    /// bring. `None` for a method that does not decide by shares.
    #[must_use]
    pub fn make_from(self, share: f64) -> Option<Box<dyn LightMethod>> {
        METHODS[self.method].from.filter(|_| share > 0.0 && share <= 1.0).map(|make| make(share))
    }

    /// Columns of the working panorama that [`MethodSpec::make`] gives it, where [`MethodSpec::make_at`] can give it another.
    #[must_use]
    pub fn usual_width(self) -> Option<u32> {
        METHODS[self.method].resized.as_ref().map(|resized| resized.usual.width)
    }

    /// What `--method` takes, for people: names, and the range of the parameter where there is one.
    #[must_use]
    pub fn usage() -> String {
        let one = |entry: &Entry| match &entry.parameter {
            Some(parameter) => format!("{}[:{}]", entry.name, parameter.allowed),
            None => entry.name.to_owned(),
        };
        METHODS.iter().map(one).collect::<Vec<_>>().join(", ")
    }
}

/// The name, and the parameter where the method has one: [`FromStr`] reads it back.
impl fmt::Display for MethodSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())?;
        if METHODS[self.method].parameter.is_some() { write!(f, ":{}", self.parameter) } else { Ok(()) }
    }
}

/// Why a text names no method.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("light method {given:?} {fault}; use one of {}", MethodSpec::usage())]
pub struct MethodError {
    given: String,
    fault: MethodFault,
}

/// What is wrong with the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum MethodFault {
    #[error("is unknown")]
    Unknown,
    #[error("takes no number")]
    NoParameter,
    #[error("has a {0} that it does not take")]
    Parameter(&'static str),
}

impl FromStr for MethodSpec {
    type Err = MethodError;

    fn from_str(given: &str) -> Result<Self, MethodError> {
        let fail = |fault| MethodError { given: given.to_owned(), fault };
        let (name, number) = given.split_once(':').map_or((given, None), |(name, number)| (name, Some(number)));
        let spec = Self::all().find(|spec| spec.name() == name).ok_or_else(|| fail(MethodFault::Unknown))?;
        match (&METHODS[spec.method].parameter, number) {
            (_, None) => Ok(spec),
            (None, Some(_)) => Err(fail(MethodFault::NoParameter)),
            (Some(parameter), Some(number)) => {
                let value = number.parse().ok().filter(|value| parameter.allowed.contains(*value));
                value.map(|parameter| Self { parameter, ..spec }).ok_or_else(|| fail(MethodFault::Parameter(parameter.meaning)))
            }
        }
    }
}

impl TryFrom<String> for MethodSpec {
    type Error = MethodError;

    fn try_from(given: String) -> Result<Self, MethodError> {
        given.parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Frame, Pixels};
    use crate::lighting::StepTimes;
    use glam::Vec3;
    use mr360_protocol::video::{StereoLayout, Transfer};

    #[test]
    fn every_method_answers_to_what_selects_it() {
        let specs = ["directional", "sh:25", "median-cut:1", "variance-cut:64", "k-means:7"].map(|text| text.parse().unwrap());
        for spec in MethodSpec::all().chain(specs) {
            assert_eq!(spec.make().name(), spec.to_string());
            assert_eq!(spec.to_string().parse::<MethodSpec>(), Ok(spec));
            // The name alone means the default parameter.
            assert!(MethodSpec::all().any(|default| spec.name().parse() == Ok(default)), "{spec}");
        }
        assert_eq!(MethodSpec::default().to_string(), "directional");
        assert_eq!(MethodSpec::all().next(), Some(MethodSpec::default()));
    }

    #[test]
    fn methods_find_an_even_sky_at_every_width_that_they_can_be_made_at() {
        let texels = vec![[0.25, 0.5, 1.0]; 64 * 32];
        let pixels = Pixels::Rgb { width: 64, height: 32, texels, transfer: Transfer::Linear };
        let frame = Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels };
        for spec in MethodSpec::all().filter(|spec| spec.usual_width().is_some()) {
            for width in [8, 16, 32, 64, 128, 256, 512, 1024] {
                let mut method = spec.make_at(width).unwrap();
                let estimate = method.estimate(&frame, &mut StepTimes::default()).unwrap();
                // The mean radiance; midpoints of four rows are off by 1 %.
                let mean = estimate.sh[0] / (4.0 * std::f32::consts::PI).sqrt();
                assert!((mean / Vec3::new(0.25, 0.5, 1.0) - 1.0).abs().max_element() < 0.01, "{spec} at {width}: {mean}");
            }
            assert!([0, 4, 12, 2048].iter().all(|width| spec.make_at(*width).is_none()));
        }
        let spec = |name: &str| name.parse::<MethodSpec>().unwrap();
        assert!(spec("k-means").make_at(64).is_none() && spec("k-means").usual_width().is_none());
        assert_eq!((spec("sh:25").make_at(64).unwrap().name(), spec("sh").usual_width()), ("sh:25", Some(128)));
    }

    #[test]
    fn what_cannot_be_made_is_refused_with_all_that_can() {
        for (given, fault) in [
            ("magic", "is unknown"),
            ("", "is unknown"),
            ("Directional", "is unknown"),
            ("mr360:3", "takes no number"),
            ("sh:16", "number of coefficients"),
            ("median-cut:0", "number of lights"),
            ("median-cut:65", "number of lights"),
            ("variance-cut:-1", "number of lights"),
            ("k-means:", "number of lights"),
            ("k-means:8:8", "number of lights"),
            ("k-means:99999999999999999999", "number of lights"),
        ] {
            let error = given.parse::<MethodSpec>().unwrap_err().to_string();
            assert!(error.contains(fault) && error.contains(&format!("{given:?}")), "{error}");
            assert!(MethodSpec::all().all(|spec| error.contains(spec.name())), "{error}");
            assert!(error.contains("sh[:9|25]") && error.contains("k-means[:1-64]"), "{error}");
        }
    }
}
