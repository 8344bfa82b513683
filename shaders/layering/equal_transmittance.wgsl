// Cuts at equal shares of the accumulated opacity; two marches. Twin of
// crates/core/src/kernels/layering/equal_transmittance.rs.

// March 1: transmittance of the whole ray and the end of its content.
struct Profile {
    transmittance: f32,
    s_last: f32,
}

// March 2: cuts the content.
struct Cuts {
    // Optical depth from the start of the content to the next cut.
    tau_cut: f32,
    tau_total: f32,
    has_open: bool,
    open: OpenSegment,
}

var<private> profile: Profile;
var<private> cuts: Cuts;
// Which of the two sinks the march feeds.
var<private> cutting: bool;

fn generate_list(ray: Ray, lattice: Lattice) {
    profile = Profile(1.0, 0.0);
    cutting = false;
    march(ray, lattice);
    cuts.tau_cut = depth_of_cut(1u);
    cuts.tau_total = 0.0;
    cuts.has_open = false;
    cutting = true;
    march(ray, lattice);
    if (cuts.has_open && cuts.open.tau > 0.0) {
        push(cuts.open);
    }
}

fn sink_step(step: Step) -> u32 {
    if (cutting) {
        return cuts_step(step);
    }
    return profile_step(step);
}

fn profile_step(step: Step) -> u32 {
    profile.transmittance *= 1.0 - step.alpha;
    profile.s_last = step.s1;
    return select(0u, pace_behind(profile.transmittance), profile.transmittance > TRANSMITTANCE_MIN);
}

// Optical depth at which the share i/K is reached; out of reach for the last.
fn depth_of_cut(i: u32) -> f32 {
    if (i >= K) {
        return OUT_OF_REACH;
    }
    let share = f32(i) / f32(K);
    return -log(1.0 - share * (1.0 - profile.transmittance));
}

// Adds a piece to the open segment; opens one at its front if there is none.
fn extend(s0: f32, s1: f32, c: vec3f, tau: f32) {
    if (!cuts.has_open) {
        cuts.open = OpenSegment(vec3f(0.0), 0.0, s0, s0, 0.0);
        cuts.has_open = true;
    }
    cuts.open.c += c * (1.0 - cuts.open.alpha);
    cuts.open.alpha += opacity(tau) * (1.0 - cuts.open.alpha);
    cuts.open.tau += tau;
    cuts.open.s1 = s1;
}

fn cuts_step(step: Step) -> u32 {
    var s0 = step.s0;
    let s1 = step.s1;
    var c = step.c;
    var tau = step.tau;
    while (cuts.tau_total + tau > cuts.tau_cut && list.len + 1u < K) {
        let part = clamp((cuts.tau_cut - cuts.tau_total) / tau, 0.0, 1.0);
        let s_cut = s0 + (s1 - s0) * part;
        let c_part = c * (opacity(tau * part) / opacity(tau));
        extend(s0, s_cut, c_part, tau * part);
        push(cuts.open);
        // The rest of the step, and an open segment that starts at the cut: the list has no gaps.
        c *= opacity(tau * (1.0 - part)) / opacity(tau);
        cuts.tau_total += tau * part;
        tau *= 1.0 - part;
        s0 = s_cut;
        cuts.open = OpenSegment(vec3f(0.0), 0.0, s_cut, s_cut, 0.0);
        cuts.has_open = true;
        cuts.tau_cut = depth_of_cut(list.len + 1u);
    }
    extend(s0, s1, c, tau);
    cuts.tau_total += tau;
    return select(0u, pace_behind(exp(-cuts.tau_total)), s1 < profile.s_last);
}

// More than any optical depth.
const OUT_OF_REACH: f32 = 3e38;
