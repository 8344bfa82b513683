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
fn extend(piece: Step) {
    if (!cuts.has_open) {
        cuts.open = no_segment();
        cuts.open.s0 = piece.s0;
        cuts.has_open = true;
    }
    cuts.open = appended(cuts.open, piece);
}

fn cuts_step(step: Step) -> u32 {
    var rest = step;
    while (cuts.tau_total + rest.tau > cuts.tau_cut && out.len + 1u < K) {
        let part = clamp((cuts.tau_cut - cuts.tau_total) / rest.tau, 0.0, 1.0);
        let parts = split(rest, part);
        extend(parts.near);
        push(cuts.open);
        cuts.tau_total += parts.near.tau;
        rest = parts.far;
        // The next one starts at the cut: the list has no gaps.
        cuts.open = no_segment();
        cuts.open.s0 = rest.s0;
        cuts.open.s1 = rest.s0;
        cuts.tau_cut = depth_of_cut(out.len + 1u);
    }
    extend(rest);
    cuts.tau_total += rest.tau;
    return select(0u, pace_behind(exp(-cuts.tau_total)), step.s1 < profile.s_last);
}

// More than any optical depth.
const OUT_OF_REACH: f32 = 3e38;
