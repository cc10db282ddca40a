use super::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn geometries() -> Vec<Geo> {
    let d2 = |b, side, c, n, k, s, p| Geo {
        b,
        h: side,
        w: side + 1,
        c,
        n,
        kh: k,
        kw: k,
        sh: s,
        sw: s,
        ph: p,
        pw: p,
    };
    let d1 = |b, w, c, n, k, s, p| Geo { b, h: 1, w, c, n, kh: 1, kw: k, sh: 1, sw: s, ph: 0, pw: p };
    vec![
        d2(3, 9, 3, 16, 7, 2, 3),
        d2(2, 8, 16, 16, 3, 1, 1),
        d2(2, 7, 17, 33, 3, 2, 1),
        d2(2, 6, 32, 48, 1, 2, 0),
        d2(1, 2, 20, 70, 3, 1, 1),
        d2(40, 5, 16, 24, 3, 1, 1),
        d1(5, 16, 8, 64, 5, 1, 2),
        d1(3, 16, 24, 8, 1, 1, 0),
        d1(2, 8, 40, 40, 3, 2, 1),
        d1(4, 16, 12, 20, 4, 2, 1),
        d1(1, 4, 300, 130, 5, 1, 2),
        Geo::linear(130, 70, 90),
    ]
}

fn random(n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..n).map(|_| rng.random::<f32>() - 0.5).collect()
}

/// Calls `f(input, output, weight)` with the indices of every product, in `f64` loops.
fn naive(g: &Geo, mut f: impl FnMut(usize, usize, usize)) {
    for b in 0..g.b {
        for (oy, ox) in (0..g.out_h()).flat_map(|y| (0..g.out_w()).map(move |x| (y, x))) {
            for tap in 0..g.taps() {
                let y = (oy * g.sh + tap / g.kw).checked_sub(g.ph).filter(|y| *y < g.h);
                let x = (ox * g.sw + tap % g.kw).checked_sub(g.pw).filter(|x| *x < g.w);
                let Some((y, x)) = y.zip(x) else { continue };
                for (c, n) in (0..g.c).flat_map(|c| (0..g.n).map(move |n| (c, n))) {
                    f(
                        ((b * g.h + y) * g.w + x) * g.c + c,
                        ((b * g.out_h() + oy) * g.out_w() + ox) * g.n + n,
                        (tap * g.c + c) * g.n + n,
                    );
                }
            }
        }
    }
}

fn close(what: &str, g: &Geo, isa: Isa, found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(1e-3f64, |m, v| m.max(v.abs()));
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*a) - b).abs() < 2e-6 * scale, "{what} {g:?} {isa:?} at {i}: {a} for {b}");
    }
}

#[test]
fn every_instruction_set_computes_the_plain_sums() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for g in geometries() {
        let x = random(g.b * g.size(), &mut rng);
        let w = random(g.taps() * g.c * g.n, &mut rng);
        let bias = random(g.n, &mut rng);
        let dy = random(g.m() * g.n, &mut rng);
        let mut y: Vec<f64> = (0..dy.len()).map(|i| f64::from(bias[i % g.n])).collect();
        let mut dx = vec![0.0; x.len()];
        let mut dw = vec![0.0; w.len()];
        naive(&g, |i, o, k| {
            y[o] += f64::from(x[i]) * f64::from(w[k]);
            dx[i] += f64::from(dy[o]) * f64::from(w[k]);
            dw[k] += f64::from(dy[o]) * f64::from(x[i]);
        });
        let dw = dw.iter().map(|v| *v as f32).collect::<Vec<_>>();
        let dw: Vec<f64> = in_panels(&dw, g.n, false).into_iter().map(f64::from).collect();
        let w = in_panels(&w, g.n, false);
        // The same numbers as the transposed layer has them: (taps, n) by c.
        let wt = flip(&w, g.taps(), g.c, g.n);
        let bias_c = random(g.c, &mut rng);
        let up: Vec<f64> = dx.iter().enumerate().map(|(i, v)| v + f64::from(bias_c[i % g.c])).collect();
        for isa in Isa::all() {
            close("forward", &g, isa, &forward_with(isa, &x, &w, Some(&bias), &g), &y);
            close("input", &g, isa, &input_grad_with(isa, &w, &dy, &g), &dx);
            close("weight", &g, isa, &weight_grad_with(isa, &x, &dy, &g), &dw);
            close("transposed", &g, isa, &transposed_forward_with(isa, &dy, &wt, &bias_c, &g), &up);
        }
    }
}

/// Numbers of a normal distribution, nearly.
fn normal(n: usize, scale: f32, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..n).map(|_| (0..12).map(|_| rng.random::<f32>() - 0.5).sum::<f32>() * scale).collect()
}

/// The norm of the difference over the norm.
fn off(found: &[f32], expected: &[f64]) -> f64 {
    let d: f64 = found.iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
    (d / expected.iter().map(|v| v * v).sum::<f64>()).sqrt()
}

/// Sums over thousands of products, against those in `f64`. torch 2.15 is 2.0e-7 off in results and gradients of inputs,
/// and 2.3e-6 in such gradients of weights; one sum without blocks is 8.7e-7 and 8.4e-7 off.
#[test]
fn long_sums_keep_their_digits() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let d2 = |b, h, w, c, n| Geo { b, h, w, c, n, kh: 3, kw: 3, sh: 1, sw: 1, ph: 1, pw: 1 };
    for (g, long) in
        [(d2(2, 3, 2, 512, 48), true), (d2(2, 3, 2, 48, 512), false), (d2(64, 18, 16, 8, 9), false)]
    {
        let x = normal(g.b * g.size(), 1.0, &mut rng);
        let w = normal(g.taps() * g.c * g.n, 0.02, &mut rng);
        let dy = normal(g.m() * g.n, 1.0, &mut rng);
        let (mut y, mut dx, mut dw) = (vec![0.0; dy.len()], vec![0.0; x.len()], vec![0.0; w.len()]);
        naive(&g, |i, o, k| {
            y[o] += f64::from(x[i]) * f64::from(w[k]);
            dx[i] += f64::from(dy[o]) * f64::from(w[k]);
            dw[k] += f64::from(dy[o]) * f64::from(x[i]);
        });
        let w = in_panels(&w, g.n, false);
        for isa in Isa::all() {
            // Without a fused multiplication every product is rounded, too.
            let most = if isa == Isa::Plain && !cfg!(target_arch = "aarch64") { 3.6e-7 } else { 2.6e-7 };
            let check = |what: &str, off: f64, most: f64| {
                assert!(off < most, "{what} of {g:?} with {isa:?}: off by {off:.1e}");
            };
            if long {
                check("result", off(&forward_with(isa, &x, &w, None, &g), &y), most);
            } else if g.b < 64 {
                check("input", off(&input_grad_with(isa, &w, &dy, &g), &dx), most);
            } else {
                let found = in_panels(&weight_grad_with(isa, &x, &dy, &g), g.n, true);
                check("weight", off(&found, &dw), 1.5 * most);
            }
        }
    }
}

#[test]
fn nothing_in_gives_nothing_out_and_no_gradient() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for g in geometries().into_iter().map(|g| Geo { b: 0, ..g }) {
        let w = in_panels(&random(g.taps() * g.c * g.n, &mut rng), g.n, false);
        let bias = random(g.n, &mut rng);
        for isa in Isa::all() {
            // The allocator hands out what was just given back.
            drop(vec![f32::NAN; w.len()]);
            let dw = weight_grad_with(isa, &[], &[], &g);
            assert!(dw.len() == w.len() && dw.iter().all(|v| *v == 0.0), "{g:?} {isa:?}");
            assert!(forward_with(isa, &[], &w, Some(&bias), &g).is_empty());
            assert!(input_grad_with(isa, &w, &[], &g).is_empty());
        }
    }
}

/// Calls that would read or write outside their slices are refused in every build.
#[test]
fn wrong_sizes_are_refused() {
    let g = Geo { b: 2, h: 4, w: 5, c: 3, n: 20, kh: 3, kw: 3, sh: 1, sw: 1, ph: 0, pw: 0 };
    let (x, w, bias, dy) = (vec![0.0; 120], vec![0.0; 540], vec![0.0; 20], vec![0.0; 240]);
    let refused = |what: &str, f: &(dyn Fn() + std::panic::RefUnwindSafe)| {
        let message = std::panic::catch_unwind(f).unwrap_err();
        let text = message.downcast::<String>().map_or_else(|_| String::new(), |s| *s);
        assert!(text.contains(what), "{what}: {text}");
    };
    drop(forward(&x, &w, Some(&bias), &g));
    refused("bias of Some(19)", &|| drop(forward(&x, &w, Some(&bias[1..]), &g)));
    refused("outside its slices", &|| drop(forward(&x[1..], &w, None, &Geo { c: 16, kh: 1, kw: 1, ..g })));
    refused("outside its slices", &|| drop(forward(&x, &w[..519], None, &g)));
    refused("outside its slices", &|| drop(weight_grad(&x, &dy[1..], &g)));
    let small = Geo { h: 2, ..g };
    refused("larger than the padded input", &|| drop(forward(&x[..60], &w, None, &small)));
    refused("larger than the padded input", &|| drop(weight_grad(&x[..60], &dy, &small)));
    refused("larger than the padded input", &|| drop(input_grad(&w, &dy, &small)));
    refused("larger than the padded input", &|| drop(transposed_forward(&dy, &w, &bias[..3], &small)));
    refused("too large a sample", &|| drop(forward(&x, &w, None, &Geo { h: 1 << 16, w: 1 << 16, ..g })));
}

#[test]
fn sums_do_not_depend_on_the_threads() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for g in geometries() {
        let x = random(g.b * g.size(), &mut rng);
        let w = in_panels(&random(g.taps() * g.c * g.n, &mut rng), g.n, false);
        let dy = random(g.m() * g.n, &mut rng);
        let all = || (forward(&x, &w, None, &g), input_grad(&w, &dy, &g), weight_grad(&x, &dy, &g));
        let run = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(all);
        let one = run(1);
        assert!(one == run(2) && one == run(3), "{g:?}");
    }
}
