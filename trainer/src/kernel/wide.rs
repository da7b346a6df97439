//! Loops compiled for the widest vectors the machine has.

/// Defines functions over slices in up to three versions: for AVX-512, for AVX2 and for whatever the build assumes.
/// The first one the machine supports runs. All compute the same bits: the versions differ in vector width only, and
/// the compiler neither reorders nor fuses floating-point operations.
macro_rules! widest {
    ($(
        $(#[$meta:meta])*
        $visibility:vis fn $name:ident $(<$scalar:ident: Scalar>)? ($($argument:ident: $type:ty),* $(,)?) $body:block
    )*) => {$(
        $(#[$meta])*
        #[cfg_attr(
            target_arch = "x86_64",
            expect(unsafe_code, reason = "calls functions compiled for instructions found at run time")
        )]
        $visibility fn $name $(<$scalar: Scalar>)? ($($argument: $type),*) {
            #[inline(always)]
            fn anywhere $(<$scalar: Scalar>)? ($($argument: $type),*) $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
                fn avx512 $(<$scalar: Scalar>)? ($($argument: $type),*) {
                    anywhere($($argument),*);
                }
                #[target_feature(enable = "avx2")]
                fn avx2 $(<$scalar: Scalar>)? ($($argument: $type),*) {
                    anywhere($($argument),*);
                }
                if is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
                {
                    // SAFETY: the body is safe code, and the machine has just been found to have the instructions.
                    return unsafe { avx512($($argument),*) };
                }
                if is_x86_feature_detected!("avx2") {
                    // SAFETY: as above.
                    return unsafe { avx2($($argument),*) };
                }
            }
            anywhere($($argument),*);
        }
    )*};
}

pub(super) use widest;
