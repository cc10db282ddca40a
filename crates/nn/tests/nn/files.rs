//! Names, layouts and files.

use crate::support::{fill, filled, input, rng, values};
use e2h_nn::{
    ConditionalUnet1d, Conv1d, Error, HostTensor, Linear, Mode, Params, RgbEncoder, RgbEncoderConfig,
    UnetConfig, load_weights, save_weights,
};
use std::collections::BTreeMap;

fn unet() -> UnetConfig {
    UnetConfig {
        input_dim: 2,
        down_dims: vec![16, 32],
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 16,
        cond_dim: 6,
    }
}

#[test]
fn export_and_import_are_inverse() {
    let (params, net) =
        Params::build(Mode::Train, &mut rng(1), |b| ConditionalUnet1d::new(&unet(), &b.pp("unet"))).unwrap();
    let weights = params.export().unwrap();
    assert_eq!(weights["unet.up_modules.0.2.weight"].shape, [16, 16, 4]);
    assert_eq!(weights["unet.up_modules.0.0.conv1.block.0.weight"].shape, [16, 64, 5]);
    assert_eq!(weights["unet.down_modules.0.0.cond_encoder.1.weight"].shape, [32, 22]);
    assert_eq!(params.count(), weights.values().map(|t| t.data.len()).sum::<usize>());
    let (other, copy) =
        Params::build(Mode::Infer, &mut rng(2), |b| ConditionalUnet1d::new(&unet(), &b.pp("unet"))).unwrap();
    let (x, c) = (input(1, &[2, 4, 2], 1.0, 0.0), input(2, &[2, 6], 1.0, 0.0));
    let run = |n: &ConditionalUnet1d| values(&n.forward(&x, &[3.0, 60.0], &c).unwrap());
    assert_ne!(run(&net), run(&copy));
    other.import(&weights).unwrap();
    assert_eq!(run(&net), run(&copy));
    assert_eq!(other.export().unwrap(), weights);
}

/// `weight[o][i][k]` of PyTorch multiplies input channel i at tap k.
#[test]
fn layout_of_a_convolution() {
    let (params, net) = filled(Mode::Infer, |b| Conv1d::new(2, 3, 3, 1, 0, b));
    let w = params.export().unwrap();
    let x = input(1, &[1, 3, 2], 1.0, 0.0);
    let y = values(&net.forward(&x).unwrap());
    let x = values(&x);
    for (o, got) in y.iter().enumerate() {
        let mut want = w["bias"].data[o];
        for i in 0..2 {
            for k in 0..3 {
                want += w["weight"].data[(o * 2 + i) * 3 + k] * x[k * 2 + i];
            }
        }
        assert!((got - want).abs() < 1e-6);
    }
}

#[test]
fn import_lists_every_difference_and_changes_nothing() {
    let (params, _) = filled(Mode::Train, |b| Linear::new(2, 3, b));
    let before = params.export().unwrap();
    let mut wrong = before.clone();
    wrong.remove("bias");
    wrong.insert("extra".into(), HostTensor { shape: vec![1], data: vec![1.0] });
    wrong.get_mut("weight").unwrap().shape = vec![2, 3];
    match params.import(&wrong).unwrap_err() {
        Error::Import { missing, unexpected, misshaped } => {
            assert_eq!((missing, unexpected), (vec!["bias".to_owned()], vec!["extra".to_owned()]));
            assert!(
                misshaped.len() == 1 && misshaped[0].contains("expected [3, 2], found [2, 3]"),
                "{misshaped:?}"
            );
        }
        other => panic!("{other}"),
    }
    assert_eq!(params.export().unwrap(), before);
}

#[test]
fn a_name_used_twice_is_an_error() {
    let built =
        Params::build(Mode::Train, &mut rng(0), |b| Ok((Linear::new(2, 3, b)?, Linear::new(2, 3, b)?)));
    assert!(matches!(built, Err(Error::Duplicate(_))));
}

#[test]
fn files_round_trip() {
    let (params, _) =
        Params::build(Mode::Train, &mut rng(1), |b| ConditionalUnet1d::new(&unet(), b)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    let metadata = BTreeMap::from([("step".to_owned(), "12".to_owned())]);
    let weights = params.export().unwrap();
    save_weights(&path, &fill(&weights), &BTreeMap::new()).unwrap();
    save_weights(&path, &weights, &metadata).unwrap();
    assert_eq!(load_weights(&path).unwrap(), (weights.clone(), metadata.clone()));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no file is left beside");
    let bytes = std::fs::read(&path).unwrap();
    save_weights(&path, &weights, &metadata).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), bytes, "the same weights give the same bytes");
    std::fs::write(&path, b"no weights").unwrap();
    assert!(matches!(load_weights(&path), Err(Error::File { .. })));
    assert!(matches!(load_weights(folder.path().join("none")), Err(Error::Io { .. })));
    let wrong = BTreeMap::from([("a".to_owned(), HostTensor { shape: vec![3], data: vec![0.0] })]);
    assert!(save_weights(&path, &wrong, &metadata).is_err());
}

#[test]
fn encoder_takes_other_sizes_and_names_its_shapes() {
    let config = RgbEncoderConfig {
        height: 64,
        width: 64,
        base_width: 16,
        stage_blocks: vec![2, 2],
        keypoints: 32,
        feature_dim: 64,
    };
    assert_eq!(config.map_size(), (8, 8));
    let (params, net) = filled(Mode::Infer, |b| RgbEncoder::new(&config, b));
    assert!(params.names().any(|n| n == "backbone.5.0.downsample.1.weight"));
    for size in [64, 33] {
        let y = net.forward(&input(1, &[2, size, size, 3], 0.5, 0.5)).unwrap();
        assert_eq!(y.dims(), [2, 64]);
    }
    assert!(matches!(net.forward(&input(1, &[2, 3, 64, 64], 0.5, 0.5)), Err(Error::Shape { .. })));
    let broken = RgbEncoderConfig { base_width: 20, ..config };
    assert!(broken.validate().unwrap_err().to_string().contains("multiple of 16, found 20"));
}

#[test]
fn unet_names_its_shapes() {
    let (_, net) = filled(Mode::Infer, |b| ConditionalUnet1d::new(&unet(), b));
    let c = input(2, &[2, 6], 1.0, 0.0);
    let error = net.forward(&input(1, &[2, 5, 2], 1.0, 0.0), &[0.0, 0.0], &c).unwrap_err();
    assert!(error.to_string().contains("a multiple of 2"), "{error}");
    assert!(net.forward(&input(1, &[2, 4, 2], 1.0, 0.0), &[0.0], &c).is_err());
    assert!(UnetConfig { kernel_size: 4, ..unet() }.validate().is_err());
    assert!(UnetConfig { n_groups: 7, ..unet() }.validate().is_err());
}
