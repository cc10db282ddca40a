//! The client: with our server and with others'.

use crate::common::{policy, seen, settings};
use e2h_core::{Observation, Policy as _, Rng, stream};
use e2h_serve::wire::{Array, Value};
use e2h_serve::{RemotePolicy, RemoteSettings, Servable as _, Server, Settings, Token};
use std::net::{SocketAddr, TcpListener};
use std::thread::JoinHandle;
use std::time::Duration;
use tungstenite::Message;

fn remote(address: SocketAddr) -> RemoteSettings {
    RemoteSettings {
        url: format!("ws://{address}"),
        token: None,
        connections: 3,
        patience: Duration::from_secs(20),
        prompt: "put it on".to_owned(),
        cameras: vec!["wrist".to_owned(), "table".to_owned()],
        most_actions: None,
    }
}

fn observations(n: u64) -> Vec<Observation> {
    let inputs = policy(&["wrist", "table"]).inputs();
    let ours = |k| {
        let seen = seen(k, &inputs);
        Observation { state: seen.state.try_into().unwrap(), frames: seen.images }
    };
    (0..n).map(ours).collect()
}

#[test]
fn a_served_policy_acts_as_the_policy_itself_and_uses_the_same_random_numbers() {
    let local = policy(&["wrist", "table"]);
    let token = Token::new("sesame").unwrap();
    let with_token = Settings { token: Some(token.clone()), ..settings() };
    let server = Server::start(Box::new(policy(&["wrist", "table"])), with_token).unwrap();
    let refused = RemotePolicy::connect(remote(server.address())).err().unwrap().to_string();
    assert!(refused.contains("401"), "{refused}");
    let served =
        RemotePolicy::connect(RemoteSettings { token: Some(token), ..remote(server.address()) }).unwrap();
    assert_eq!(e2h_core::Policy::n_obs_steps(&served), 2);
    let all = observations(10);
    // Seven simulations over three connections.
    let histories: Vec<Vec<&Observation>> = (0..7).map(|i| vec![&all[i], &all[i + 1]]).collect();
    let streams = || (0..7).map(|i| stream(3, "act", 0, i)).collect::<Vec<Rng>>();
    let (mut here, mut there) = (streams(), streams());
    for _ in 0..3 {
        let a = e2h_core::Policy::act(&local, &histories, &mut here).unwrap();
        let b = served.act(&histories, &mut there).unwrap();
        assert_eq!(a, b);
        assert_eq!(here, there);
    }
}

/// A server of one connection that sends `metadata` and answers each message as `reply` says.
fn stranger(
    metadata: Value,
    replies: usize,
    reply: impl Fn(&Value) -> Message + Send + 'static,
) -> (SocketAddr, JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let thread = std::thread::spawn(move || {
        let mut socket = tungstenite::accept(listener.accept().unwrap().0).unwrap();
        socket.send(Message::Binary(metadata.encode().into())).unwrap();
        for _ in 0..replies {
            let Ok(Message::Binary(bytes)) = socket.read() else { return };
            socket.send(reply(&Value::decode(&bytes).unwrap())).unwrap();
        }
    });
    (address, thread)
}

fn binary(value: &Value) -> Message {
    Message::Binary(value.encode().into())
}

#[test]
fn another_server_gets_both_names_of_the_cameras_a_prompt_and_a_seed() {
    let (address, thread) = stranger(Value::map([]), 2, |request| {
        for (key, sides) in [
            ("observation/state", 1),
            ("observation/image", 3),
            ("observation/wrist_image", 3),
            ("observation/images/wrist", 3),
        ] {
            match request.get(key) {
                Some(Value::Array(a)) => assert_eq!(a.shape().len(), sides, "{key}"),
                other => panic!("{key}: {other:?}"),
            }
        }
        assert_eq!(request.get("prompt"), Some(&Value::from("put it on")));
        let seed = request.get("seed").and_then(Value::as_u64).unwrap();
        let chunk: Vec<f32> = (0..50 * 8).map(|i| i as f32 + (seed % 7) as f32 * 1e-3).collect();
        binary(&Value::map([("actions", Array::f32(&[50, 8], &chunk).into())]))
    });
    let settings = RemoteSettings { connections: 1, most_actions: Some(10), ..remote(address) };
    let served = RemotePolicy::connect(settings).unwrap();
    assert_eq!(e2h_core::Policy::n_obs_steps(&served), 1);
    let all = observations(1);
    let chunk = |seed| {
        let mut rngs = [stream(seed, "act", 0, 0)];
        served.act(&[vec![&all[0]]], &mut rngs).unwrap().remove(0)
    };
    let (a, b) = (chunk(0), chunk(1));
    assert_eq!((a.len(), a[1][0].round()), (10, 8.0));
    assert_eq!(b.len(), 10);
    thread.join().unwrap();
}

#[test]
fn answers_that_do_not_fit_are_refused_by_name() {
    let all = observations(1);
    let ask = |reply: Message| {
        let reply = move |_: &Value| reply.clone();
        let (address, thread) = stranger(Value::map([]), 1, reply);
        let served = RemotePolicy::connect(RemoteSettings { connections: 1, ..remote(address) }).unwrap();
        let error = served.act(&[vec![&all[0]]], &mut [stream(0, "act", 0, 0)]).unwrap_err().to_string();
        thread.join().unwrap();
        error
    };
    let of = |array: Array| binary(&Value::map([("actions", array.into())]));
    let wrong = ask(of(Array::f32(&[50, 7], &[0.0; 350])));
    assert!(wrong.contains("[T, 8]") && wrong.contains("[50, 7] of <f4"), "{wrong}");
    assert!(ask(of(Array::f32(&[0, 8], &[]))).contains("[0, 8]"));
    assert!(ask(of(Array::f32(&[1, 8], &[f32::NAN; 8]))).contains("NaN"));
    assert!(ask(binary(&Value::map([]))).contains("found none"));
    assert!(ask(Message::Binary(vec![0xc1].into())).contains("Reserved"));
    let told = ask(Message::Text("Traceback\nKeyError: 'tactile'".into()));
    assert!(told.contains("KeyError: 'tactile'") && !told.contains('\n'), "{told}");
}

#[test]
fn a_policy_of_another_robot_is_refused_at_once() {
    let (address, thread) =
        stranger(Value::map([("action_width", Value::Int(7))]), 0, |_| binary(&Value::Nil));
    let error = RemotePolicy::connect(remote(address)).err().unwrap().to_string();
    assert!(error.contains("action_width") && error.contains("expected 8"), "{error}");
    thread.join().unwrap();
    let nobody = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let error = RemotePolicy::connect(remote(nobody)).err().unwrap().to_string();
    assert!(error.contains(&nobody.to_string()) && error.contains("connecting"), "{error}");
    let tls = RemoteSettings { url: "wss://localhost:1".to_owned(), ..remote(nobody) };
    assert!(RemotePolicy::connect(tls).err().unwrap().to_string().contains("ws://HOST:PORT"));
}
