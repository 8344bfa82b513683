// A march through one channel: a sample is a position in the transfer function's domain.

alias At = f32;

fn at_point(p: vec3f) -> At {
    return domain_at(p);
}
