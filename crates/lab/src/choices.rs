//! Choices by name: methods with the rules of their frames, and ways to read lists.

use std::fmt;
use std::str::FromStr;

use isinglass_core::kernels::raycast::Reconstruction;
use isinglass_core::mode::Mode;

use crate::rivals::Method;
use crate::rules::Rule;

/// `METHOD` or `METHOD@RULE`: a method on the frames of all rules, or on those of one, as in its paper.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MethodChoice {
    /// How frames become pictures.
    pub method: Method,
    /// The rule of the frames; `None` for every measured rule.
    pub rule: Option<Rule>,
}

impl From<Method> for MethodChoice {
    fn from(method: Method) -> Self {
        Self { method, rule: None }
    }
}

impl fmt::Display for MethodChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.rule {
            Some(rule) => write!(f, "{}@{rule}", self.method),
            None => write!(f, "{}", self.method),
        }
    }
}

impl FromStr for MethodChoice {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let (method, rule) = match s.split_once('@') {
            Some((method, rule)) => (method, Some(rule.parse()?)),
            None => (s, None),
        };
        Ok(Self { method: method.parse()?, rule })
    }
}

/// Every rule with the methods for its frames, each once. Rules that coincide in a mode appear once. A method with a
/// rule of its own only gets frames of that rule.
pub fn methods_by_rule(rules: &[Rule], methods: &[MethodChoice], mode: Mode) -> Vec<(Rule, Vec<Method>)> {
    let mut of_rules: Vec<(Rule, Vec<Method>)> = Vec::new();
    let all = rules.iter().flat_map(|rule| {
        methods.iter().filter(|choice| choice.rule.is_none()).map(|choice| (*rule, choice.method))
    });
    let own = methods.iter().filter_map(|choice| Some((choice.rule?, choice.method)));
    for (rule, method) in all.chain(own) {
        let rule = rule.in_mode(mode);
        match of_rules.iter_mut().find(|(r, _)| *r == rule) {
            Some((_, methods)) if methods.contains(&method) => {}
            Some((_, methods)) => methods.push(method),
            None => of_rules.push((rule, vec![method])),
        }
    }
    of_rules
}

/// The name on the command line and in tables.
pub fn reconstruction_name(reconstruction: Reconstruction) -> &'static str {
    match reconstruction {
        Reconstruction::Mixed => "mixed",
        Reconstruction::Nearest => "nearest",
    }
}

/// The reverse of [`reconstruction_name`].
pub fn parse_reconstruction(s: &str) -> Result<Reconstruction, String> {
    let all = [Reconstruction::Mixed, Reconstruction::Nearest];
    all.into_iter().find(|r| reconstruction_name(*r) == s).ok_or_else(|| {
        format!("unknown reconstruction '{s}', expected one of {}", all.map(reconstruction_name).join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back_and_unknown_ones_refused_with_all_known() {
        let names = ["point-warp@single-depth", "layers@all-samples", "slabs-mesh@slabs", "layers"];
        for name in names {
            assert_eq!(name.parse::<MethodChoice>().unwrap().to_string(), name);
        }
        for (bad, known) in
            [("warp@slabs", "slabs-mesh"), ("layers@best", "all-samples"), ("layers@best", "homogeneity")]
        {
            let error = bad.parse::<MethodChoice>().unwrap_err();
            assert!(error.contains(known), "{error}");
        }
        for reconstruction in [Reconstruction::Mixed, Reconstruction::Nearest] {
            assert_eq!(parse_reconstruction(reconstruction_name(reconstruction)), Ok(reconstruction));
        }
        assert!(parse_reconstruction("best").unwrap_err().contains("mixed, nearest"));
    }

    #[test]
    fn a_method_with_a_rule_of_its_own_gets_no_other_frames() {
        let rules = ["visibility-merge", "slabs"].map(|r| r.parse().unwrap());
        let methods = ["layers", "slabs-mesh@slabs", "point-warp@single-depth", "layers@slabs"];
        let methods = methods.map(|m| m.parse().unwrap());
        let expected = [
            (Rule::default(), vec![Method::Layers]),
            (Rule::Slabs, vec![Method::Layers, Method::SlabsMesh]),
            ("single-depth".parse().unwrap(), vec![Method::PointWarp]),
        ];
        assert_eq!(methods_by_rule(&rules, &methods, Mode::Composite), expected);
    }

    #[test]
    fn rules_that_make_the_same_frames_in_a_mode_are_measured_once() {
        let rules = ["homogeneity", "equal-length", "slabs", "visibility-merge"].map(|r| r.parse().unwrap());
        let names = |mode| {
            let all = methods_by_rule(&rules, &[MethodChoice::default()], mode);
            all.into_iter().map(|(rule, _)| rule.name()).collect::<Vec<_>>()
        };
        assert_eq!(names(Mode::Average), ["visibility-merge"]);
        assert_eq!(names(Mode::Composite).len(), 4);
    }

    #[test]
    fn a_rule_of_one_list_length_is_measured_once() {
        let ks = |rule: &str| rule.parse::<Rule>().unwrap().ks(&[4, 8]);
        assert_eq!(
            [ks("slabs"), ks("single-depth:exit"), ks("all-samples")],
            [vec![4, 8], vec![1], vec![255]]
        );
    }
}
