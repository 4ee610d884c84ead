-- ================================================================================================
-- rosbayes: bm1_axi
-- AXI4-Lite slave: converts its channels to one access at a time.
-- MIT licence; datasheet: docs/hardware/bm1_axi.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

entity bm1_axi is
  generic (
    ADDRESS_BITS : positive -- number of bits of an address
  );
  port (
    -- system
    clk_i : in    std_logic; -- clock
    rst_i : in    std_logic; -- reset of the board
    -- AXI4-Lite
    axi_awvalid : in    std_logic; -- write address channel
    axi_awready : out   std_logic;
    axi_awaddr  : in    std_logic_vector(ADDRESS_BITS - 1 downto 0);
    axi_wvalid  : in    std_logic; -- write data channel
    axi_wready  : out   std_logic;
    axi_wdata   : in    std_logic_vector(31 downto 0);
    axi_wstrb   : in    std_logic_vector(3 downto 0);
    axi_bvalid  : out   std_logic; -- write response channel
    axi_bready  : in    std_logic;
    axi_bresp   : out   std_logic_vector(1 downto 0);
    axi_arvalid : in    std_logic; -- read address channel
    axi_arready : out   std_logic;
    axi_araddr  : in    std_logic_vector(ADDRESS_BITS - 1 downto 0);
    axi_rvalid  : out   std_logic; -- read data channel
    axi_rready  : in    std_logic;
    axi_rdata   : out   std_logic_vector(31 downto 0);
    axi_rresp   : out   std_logic_vector(1 downto 0);
    -- access
    request_o : out   std_logic;                                   -- pulse: an access begins
    write_o   : out   std_logic;                                   -- 1: write, 0: read
    address_o : out   std_logic_vector(ADDRESS_BITS - 1 downto 0); -- byte address
    strobe_o  : out   std_logic_vector(3 downto 0);                -- byte enables of a write
    data_o    : out   std_logic_vector(31 downto 0);               -- data to write
    respond_i : in    std_logic;                                   -- pulse: the access is complete
    refused_i : in    std_logic;                                   -- with respond_i: 1 if the access was refused
    data_i    : in    std_logic_vector(31 downto 0)                -- read data
  );
end entity bm1_axi;

architecture rtl of bm1_axi is

  type state_t is (idle, busy_write, busy_read, answer_write, answer_read);

  constant OKAY   : std_logic_vector(1 downto 0) := "00";
  constant SLVERR : std_logic_vector(1 downto 0) := "10";

  signal state      : state_t                       := idle;
  signal answer     : std_logic_vector(1 downto 0)  := OKAY;
  signal data       : std_logic_vector(31 downto 0) := (others => '0');
  signal take_write : std_logic;
  signal take_read  : std_logic;
  signal prefer     : std_logic                     := '0'; -- a read had to wait: it has priority

begin

  take_write <= '1' when state = idle and rst_i = '0' and axi_awvalid = '1' and axi_wvalid = '1'
                         and not (prefer = '1' and axi_arvalid = '1') else
                '0';
  take_read  <= '1' when state = idle and rst_i = '0' and axi_arvalid = '1' and take_write = '0' else
                '0';

  sequence_of_channels : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (rst_i = '1') then
        state  <= idle;
        prefer <= '0';
      else
        -- no case: GHDL's synthesis turns a case over an enumeration into latches
        if (state = idle) then
          if (take_write = '1') then
            state  <= busy_write;
            prefer <= '1';
          elsif (take_read = '1') then
            state  <= busy_read;
            prefer <= '0';
          end if;
        elsif (state = busy_write) then
          if (respond_i = '1') then
            state <= answer_write;
          end if;
        elsif (state = busy_read) then
          if (respond_i = '1') then
            state <= answer_read;
          end if;
        elsif (state = answer_write) then
          if (axi_bready = '1') then
            state <= idle;
          end if;
        else
          if (axi_rready = '1') then
            state <= idle;
          end if;
        end if;

        if (respond_i = '1') then
          answer <= OKAY;
          data   <= data_i;
          if (refused_i = '1') then
            answer <= SLVERR;
            data   <= (others => '0');
          end if;
        end if;
      end if;
    end if;

  end process sequence_of_channels;

  axi_awready <= take_write;
  axi_wready  <= take_write;
  axi_arready <= take_read;
  axi_bvalid  <= '1' when state = answer_write else
                 '0';
  axi_rvalid  <= '1' when state = answer_read else
                 '0';
  axi_bresp   <= answer;
  axi_rresp   <= answer;
  axi_rdata   <= data;

  request_o <= take_write or take_read;
  write_o   <= take_write;
  address_o <= axi_awaddr when take_write = '1' else
               axi_araddr;
  strobe_o  <= axi_wstrb;
  data_o    <= axi_wdata;

end architecture rtl;
