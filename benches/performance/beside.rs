//! Fusion while training runs use every core.

use sightfix::app::RunRequest;
use sightfix::domain::{CameraId, Durability, NewCamera, Recipe};
use sightfix::simulation::{Options, Scene, simulate};

use crate::load;
use crate::ratio::median;
use crate::served::{Served, runtime};
use crate::tables;
use crate::transports::request_body;

const EACH: usize = 1_500;
const ROUNDS: usize = 5;

pub(crate) fn run() {
    let runtime = runtime();
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    runtime.block_on(async {
        let served = Served::start_with(cores).await;
        let samples =
            simulate(&Options { samples: 10_000, ..Options::new(Scene::Square) }).training_samples();
        let mut cameras = Vec::new();
        for number in 0..cores {
            let id = CameraId::new(&format!("busy-{number}")).expect("a slug");
            served.app.cameras().create(NewCamera::named(id.clone())).await.expect("a new camera");
            served
                .app
                .store
                .insert_samples(&id, samples.clone(), Durability::Synced)
                .await
                .expect("samples are stored");
            cameras.push(id);
        }
        let path = format!("/v1/cameras/{}/fusions", served.camera);
        let request = load::post(&path, "application/json", &request_body(&served.observations[..1]));
        load::send(served.address, &request, EACH).await;
        let (mut rates, mut late) = (Vec::new(), Vec::new());
        for _ in 0..ROUNDS {
            let (quiet, mut quiet_times) = load::send(served.address, &request, EACH).await;
            let mut runs = Vec::new();
            for id in &cameras {
                let wish =
                    RunRequest { recipe: Some(Recipe::Paper), epochs: Some(10_000), ..RunRequest::default() };
                runs.push((id, served.app.training().start(id, wish, None).await.expect("a run").id));
            }
            // Until the fits are under way.
            tokio::time::sleep(std::time::Duration::from_millis(700)).await;
            let (busy, mut busy_times) = load::send(served.address, &request, EACH).await;
            for (id, run) in runs {
                served.app.training().cancel(id, run).await.expect("the run still goes");
                while !served.app.training().get(id, run).await.expect("the run").state.has_ended() {
                    tokio::time::sleep(std::time::Duration::from_millis(20)).await;
                }
            }
            rates.push(busy / quiet);
            late.push(percentile(&mut busy_times, 0.99) / percentile(&mut quiet_times, 0.99));
        }
        let title = format!("Fusion while a training run uses each of {cores} cores");
        tables::head(&title, &["measure", "busy / quiet"]);
        tables::row("requests per second", &[(median(&mut rates), 2)]);
        tables::row("99th percentile of the latency", &[(median(&mut late), 2)]);
        served.end();
    });
}

fn percentile(times: &mut [f64], share: f64) -> f64 {
    times.sort_by(f64::total_cmp);
    times[((times.len() - 1) as f64 * share) as usize]
}
