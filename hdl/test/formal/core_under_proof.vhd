-- ================================================================================================
-- rosbayes: core_under_proof
-- A small machine whose tables and seeds are left open: a proof holds for whatever they hold.
-- MIT licence; datasheet: docs/hardware/verification.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity core_under_proof is
  generic (
    REPLICAS : positive := 1 -- machines that share the generators
  );
  port (
    clk_i             : in    std_logic;
    rst_i             : in    std_logic;
    start_i           : in    std_logic;
    resume_i          : in    std_logic;
    reset_i           : in    std_logic;
    target_i          : in    std_logic_vector(2 downto 0);
    max_cycles_i      : in    std_logic_vector(63 downto 0);
    run_until_i       : in    std_logic_vector(63 downto 0);
    halt_i            : in    std_logic_vector(REPLICAS - 1 downto 0);
    addresses_i       : in    std_logic_vector(REPLICAS * SLOT_BITS - 1 downto 0);
    running_o         : out   std_logic;
    done_o            : out   std_logic;
    has_run_o         : out   std_logic;
    cycles_o          : out   std_logic_vector(63 downto 0);
    reason_o          : out   std_logic_vector(2 downto 0);
    ready_o           : out   std_logic_vector(REPLICAS - 1 downto 0);
    replica_reasons_o : out   std_logic_vector(3 * REPLICAS - 1 downto 0);
    replica_cycles_o  : out   std_logic_vector(64 * REPLICAS - 1 downto 0);
    counts_o          : out   std_logic_vector(REPLICAS * 6 - 1 downto 0)
  );
end entity core_under_proof;

architecture rtl of core_under_proof is

begin

  core : entity work.bm1_core
    generic map (
      lines         => 2,
      sensors       => 1,
      replicas      => REPLICAS,
      mode          => SENSOR_COLUMN,
      address_bits  => (1 => 2),
      prob_bits     => 2,
      prior_bits    => 0,
      written       => false,
      counter_bits  => 3,
      kind          => RNG_LFSR8,
      state_bits    => 8,
      taps          => x"B8",
      rng_shared    => true,
      steps         => 2,
      banks         => 1,
      reset_bank    => true,
      table_length  => 1,
      memory_folder => "",
      board         => 0
    )
    port map (
      clk_i             => clk_i,
      rst_i             => rst_i,
      start_i           => start_i,
      resume_i          => resume_i,
      reset_i           => reset_i,
      target_i          => target_i,
      max_cycles_i      => max_cycles_i,
      run_until_i       => run_until_i,
      bank_i            => "0",
      halt_i            => halt_i,
      priors_i          => addresses_i,
      prior_codes_i     => (others => '0'),
      inputs_i          => addresses_i,
      running_o         => running_o,
      done_o            => done_o,
      has_run_o         => has_run_o,
      cycles_o          => cycles_o,
      reason_o          => reason_o,
      ready_o           => ready_o,
      replica_reasons_o => replica_reasons_o,
      replica_cycles_o  => replica_cycles_o,
      counts_o          => counts_o
    );

end architecture rtl;
