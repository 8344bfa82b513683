//! Functions compiled several times: for every machine, and with wider instructions where the processor has them.
//!
//! The crate `multiversion` does as much, but a test could not choose the width. That all widths give the same bits is
//! what lets machines decode alike, so tests run each of them.

#[cfg(target_arch = "x86_64")]
use std::sync::LazyLock;

/// Defines a function that is compiled for each [`Width`], from one that is always inlined. No multiplication is
/// fused with an addition, so the bits are the same.
macro_rules! wide {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)? = $any:path;) => {
        $(#[$meta])*
        $vis fn $name($($arg: $ty),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            {
                use $crate::simd::{Width, width};

                #[target_feature(enable = "avx2")]
                fn with_avx2($($arg: $ty),*) $(-> $out)? {
                    $any($($arg),*)
                }
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2,lzcnt,popcnt")]
                fn with_avx512($($arg: $ty),*) $(-> $out)? {
                    $any($($arg),*)
                }
                #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
                match width() {
                    // SAFETY: the processor supports these instructions.
                    Width::Avx512 => return unsafe { with_avx512($($arg),*) },
                    // SAFETY: the processor supports these instructions.
                    Width::Avx2 => return unsafe { with_avx2($($arg),*) },
                    Width::Any => {}
                }
            }
            $any($($arg),*)
        }
    };
}

/// Width of vector instructions.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Width {
    /// What every machine has.
    Any,
    /// 32 bytes.
    Avx2,
    /// 64 bytes, with masked lanes.
    Avx512,
}

/// The widest instructions that functions of [`wide`] use.
#[cfg(target_arch = "x86_64")]
#[inline]
pub(crate) fn width() -> Width {
    #[cfg(test)]
    return of_machine().min(tests::most());
    #[cfg(not(test))]
    of_machine()
}

/// The widest instructions of this machine.
#[cfg(target_arch = "x86_64")]
#[inline]
fn of_machine() -> Width {
    static OF_MACHINE: LazyLock<Width> = LazyLock::new(|| {
        use std::arch::is_x86_feature_detected as has;
        // The extra features appeared on later processors, which do not slow down for wide instructions.
        let is_late = has!("avx512vbmi2") && has!("bmi1") && has!("bmi2") && has!("lzcnt") && has!("popcnt");
        if is_late && has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl") {
            Width::Avx512
        } else if has!("avx2") {
            Width::Avx2
        } else {
            Width::Any
        }
    });
    *OF_MACHINE
}

/// Whether the processor supports functions called `_avx2`.
pub(crate) fn has_avx2() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx2");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

#[cfg(test)]
pub(crate) mod tests {
    #[cfg(target_arch = "x86_64")]
    use std::sync::{
        Mutex, PoisonError,
        atomic::{AtomicU8, Ordering},
    };

    #[cfg(target_arch = "x86_64")]
    use super::*;

    /// One test at a time has functions run as it says.
    #[cfg(target_arch = "x86_64")]
    static TURN: Mutex<()> = Mutex::new(());

    /// The widest that functions run with; it makes no difference to tests that run at once and do not say.
    #[cfg(target_arch = "x86_64")]
    static MOST: AtomicU8 = AtomicU8::new(Width::Avx512 as u8);

    #[cfg(target_arch = "x86_64")]
    pub(super) fn most() -> Width {
        [Width::Any, Width::Avx2, Width::Avx512][usize::from(MOST.load(Ordering::Relaxed))]
    }

    /// What a function gives with each width.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn with_each<T>(mut run: impl FnMut() -> T) -> [T; 3] {
        let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let found = [Width::Any, Width::Avx2, Width::Avx512].map(|most| {
            MOST.store(most as u8, Ordering::Relaxed);
            let found = run();
            assert_eq!(width(), most.min(of_machine()), "somebody else has said another width");
            found
        });
        MOST.store(Width::Avx512 as u8, Ordering::Relaxed);
        found
    }

    #[cfg(not(target_arch = "x86_64"))]
    pub(crate) fn with_each<T>(run: impl FnMut() -> T) -> [T; 3] {
        let mut run = run;
        std::array::from_fn(|_| run())
    }
}
