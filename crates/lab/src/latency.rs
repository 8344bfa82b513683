//! Quality under latency: the headless demonstration with our method and those of the papers.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use isinglass_bench::demo::{PictureMaker, Rival};
use isinglass_bench::latency::Contender;
use isinglass_core::camera::Camera;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;

use crate::choices::MethodChoice;
use crate::rivals::Method;
use crate::rules::Rule;

/// `METHOD[@RULE][:no-prediction]`: a method, the rule of the server's frames, and whether frames are requested for
/// the predicted pose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatencyMethod {
    /// Method and rule. Without a rule, frames are ours.
    pub choice: MethodChoice,
    /// Whether prediction is off, as in the papers.
    pub never_predicts: bool,
}

impl LatencyMethod {
    /// The contender for the table.
    pub fn contender(self) -> Contender {
        let rule = self.choice.rule.unwrap_or_default();
        let is_ours = rule == Rule::default() && self.choice.method == Method::Layers;
        let rival = (!is_ours).then(|| Rival {
            name: self.choice.to_string(),
            make: rule.frame_maker(),
            show: self.choice.method.picture_maker(),
        });
        Contender { rival, never_predicts: self.never_predicts }
    }
}

impl Method {
    /// How a demonstration makes its pictures; `None` for the ray cast, which it has itself.
    pub fn picture_maker(self) -> Option<PictureMaker> {
        if self == Self::Layers {
            return None;
        }
        Some(Arc::new(move |frame: &LayeredFrame, bounds: &Aabb| {
            let mut views = self.prepare_rival(frame, bounds);
            // A scripted camera is always valid.
            Box::new(move |camera: &Camera| {
                let picture = views.as_mut().and_then(|views| views.view(camera).ok());
                picture.unwrap_or_else(|| Picture::new(camera.intrinsics.width, camera.intrinsics.height))
            })
        }))
    }
}

impl fmt::Display for LatencyMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.choice, if self.never_predicts { NO_PREDICTION } else { "" })
    }
}

impl FromStr for LatencyMethod {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let (choice, never_predicts) = match s.strip_suffix(NO_PREDICTION) {
            Some(choice) => (choice, true),
            None => (s, false),
        };
        let choice: MethodChoice = choice.parse()?;
        if choice.rule == Some(Rule::AllSamples) {
            return Err(format!("'{s}': no server sends {}, expected a rule for frames", Rule::AllSamples));
        }
        Ok(Self { choice, never_predicts })
    }
}

const NO_PREDICTION: &str = ":no-prediction";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_method_is_played_as_it_is_named() {
        let of = |method: &str| method.parse::<LatencyMethod>().unwrap().contender();
        assert!(of("layers").rival.is_none() && !of("layers").never_predicts);
        assert!(of("layers:no-prediction").never_predicts);
        let warp = of("point-warp@single-depth:exit:no-prediction");
        let rival = warp.rival.unwrap();
        assert_eq!(rival.name, "point-warp@single-depth:exit");
        assert!(warp.never_predicts && rival.make.is_some() && rival.show.is_some());
        let of_paper = of("layers@equal-transmittance").rival.unwrap();
        assert!(of_paper.make.is_some() && of_paper.show.is_none());
        for bad in ["layers@all-samples", "warp", "layers:yes"] {
            assert!(bad.parse::<LatencyMethod>().is_err(), "{bad}");
        }
    }
}
