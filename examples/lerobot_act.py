"""Train ACT of LeRobot on an exported data set: it foresees the object's next poses from its pose and the
electrodes. Needs lerobot (pip install lerobot[dataset], in an environment of its own); a minute on one core.

    biotac data generate --count 200 --labelled 0 --skin coarse --tier condensed --batch 12 --out out/small
    biotac data export out/small --out out/lerobot
    python examples/lerobot_act.py out/lerobot --steps 100

LeRobot normalises and trains whatever begins with `observation.`; ACT itself reads `observation.state`,
`observation.environment_state` and images, so the electrodes are given to it under the second name."""

import argparse
import time

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

TOUCH, ENVIRONMENT = "observation.tactile.electrodes", "observation.environment_state"
AHEAD = 8  # frames that are foreseen


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("set", help="folder that `biotac data export` wrote")
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    torch.manual_seed(0)
    meta = LeRobotDatasetMetadata("biotac_mj/set", root=args.set)

    def feature(kind, name):
        return PolicyFeature(kind, tuple(meta.features[name]["shape"]))

    config = ACTConfig(
        input_features={
            "observation.state": feature(FeatureType.STATE, "observation.state"),
            ENVIRONMENT: feature(FeatureType.ENV, TOUCH),
        },
        output_features={"action": feature(FeatureType.ACTION, "action")},
        chunk_size=AHEAD,
        n_action_steps=AHEAD,
        dim_model=256,
        dim_feedforward=512,
        n_encoder_layers=2,
        device="cpu",
        push_to_hub=False,
    )
    stats = {**meta.stats, ENVIRONMENT: meta.stats[TOUCH]}
    policy, (before, _) = ACTPolicy(config), make_pre_post_processors(config, dataset_stats=stats)
    ahead = {"action": [k / meta.fps for k in range(AHEAD)]}
    data = LeRobotDataset("biotac_mj/set", root=args.set, delta_timestamps=ahead)
    print(f"{data.num_episodes} episodes, {len(data)} frames at {meta.fps} Hz")
    optimizer = torch.optim.AdamW(policy.parameters(), 1e-4)
    loader = torch.utils.data.DataLoader(data, batch_size=32, shuffle=True)
    losses, begun = [], time.time()
    while len(losses) < args.steps:
        for batch in loader:
            loss, _ = policy(before(batch | {ENVIRONMENT: batch[TOUCH]}))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
            if len(losses) == args.steps:
                break
    first, last = (sum(part) / len(part) for part in (losses[:10], losses[-10:]))
    print(f"loss {first:.2f} -> {last:.2f} in {args.steps} steps, {time.time() - begun:.0f} s")


if __name__ == "__main__":
    main()
